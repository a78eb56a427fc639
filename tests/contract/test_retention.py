"""Every strategy of retention: what it may do, and what a restart does not change."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from builders import FakePredictor, image_with
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test

from shared.config import MemoryConfig
from shared.facts import HUMAN, IMAGE_SHAPE
from shared.rl.memory import SAMPLE, ReplayMemory
from shared.rl.retention.strategy import Situation, discard
from shared.rl.retention.table import STRATEGIES

SEED = 7
WORLDS = ("plus", "minus")
samples = st.lists(
    st.tuples(st.integers(0, 2), st.integers(0, 5), st.integers(-10, 10), st.sampled_from(WORLDS)),
    min_size=1,
    max_size=25,
)
"""Action, what the image shows, reward in tenths, and world."""


class Memories(RuleBasedStateMachine):
    """A memory, and a twin that is restarted before every discard and that a person filled."""

    strategy = "rmm"

    def __init__(self) -> None:
        super().__init__()
        self.config = MemoryConfig(capacity=30, strategy=self.strategy, threshold_percent=2)
        self.memory, self.twin = ReplayMemory(30), ReplayMemory(30)
        self.version, self.episode, self.next_id = 1, 0, 1
        self.given: dict[int, tuple[Any, ...]] = {}

    @rule(new=samples)
    def an_episode(self, new: list[tuple[int, int, int, str]]) -> None:
        """Append and discard."""
        self.episode += 1
        for memory in (self.memory, self.twin):
            self._append(memory, new)
        self.next_id += len(new)
        self.twin = restarted(self.twin)
        before = [int(i) for i in self.memory.ids]
        done = [discard(self._situation(memory)) for memory in (self.memory, self.twin)]
        assert done[0].ids.tolist() == done[1].ids.tolist()
        assert done[0].told == done[1].told
        gone = done[0].ids.tolist()
        assert gone == sorted(set(gone))
        assert set(gone) <= set(before)
        assert [int(i) for i in self.memory.ids] == [i for i in before if i not in set(gone)]
        if len(before) <= 30:
            assert not gone

    @rule(jump=st.integers(1, 3))
    def new_weights(self, jump: int) -> None:
        """A target network is published."""
        self.version += jump

    @invariant()
    def no_more_than_fit(self) -> None:
        """len(D) <= N after every discard."""
        assert len(self.memory) <= self.memory.capacity == 30

    @invariant()
    def nothing_appears_or_changes(self) -> None:
        """What is there was given, as it was given."""
        images = self.memory.images(np.arange(len(self.memory)))
        for row, image in zip(self.memory.rows, images, strict=True):
            found = (row["action"], round(10 * row["reward"]), self.memory.worlds[row["world"]])
            assert (*found, image.tobytes()[:15]) == self.given[int(row["id"])]

    @invariant()
    def a_restart_changes_nothing(self) -> None:
        """All columns and numbers are those of the memory that was never restarted."""
        rows, twin = self.memory.rows.copy(), self.twin.rows.copy()
        rows["slot"] = twin["slot"] = 0
        assert np.all(twin["by"] == HUMAN)
        twin["by"] = 0  # no strategy treats a person's samples otherwise than others
        assert rows.tobytes() == twin.tobytes()
        assert self.memory.kept == self.twin.kept
        self.memory.check_valid()

    def _situation(self, memory: ReplayMemory) -> Situation:
        return Situation(memory, self.episode, self.config, FakePredictor(self.version), seed=SEED)

    def _append(self, memory: ReplayMemory, new: list[tuple[int, int, int, str]]) -> None:
        rows = np.zeros(len(new), SAMPLE)
        images = np.zeros((len(new), *IMAGE_SHAPE), np.uint8)
        first = self.next_id
        for i, (action, shows, tenths, world) in enumerate(new):
            front = bytes([shows] * 15)
            rows[i]["id"], rows[i]["action"], rows[i]["reward"] = first + i, action, tenths / 10
            rows[i]["world"] = memory.world_indices([world])[0]
            rows[i]["x_m"], rows[i]["episode"] = shows, self.episode
            rows[i]["by"] = HUMAN if memory is self.twin else 0
            images[i] = np.frombuffer(image_with(front), np.uint8).reshape(IMAGE_SHAPE)
            self.given[first + i] = (action, tenths, world, front)
        memory.append(rows, images)


def restarted(memory: ReplayMemory) -> ReplayMemory:
    """The memory as it comes back from disk."""
    again = ReplayMemory(memory.capacity)
    again.worlds, again.kept = list(memory.worlds), dict(memory.kept)
    again.append(memory.rows, memory.images(np.arange(len(memory))))
    return again


@pytest.mark.parametrize("name", STRATEGIES)
def test_it_keeps_within_its_bounds_and_through_restarts(name: str) -> None:
    machine = type("Machine", (Memories,), {"strategy": name})
    run_state_machine_as_test(
        machine,
        settings=settings(
            max_examples=12,
            stateful_step_count=12,
            deadline=None,
            derandomize=True,
            suppress_health_check=list(HealthCheck),
        ),
    )


CAPACITY, PLUS, MINUS = 300, 29, 7


def shares_after_minus(name: str, seed: int) -> float:
    """Share of Plus after 29 N samples of it and 7 N of Minus, none like another."""
    config = MemoryConfig(capacity=CAPACITY, strategy=name)
    memory, network = ReplayMemory(CAPACITY), FakePredictor()
    draw, part = np.random.default_rng(seed), CAPACITY // 10
    for number in range((PLUS + MINUS) * CAPACITY // part):
        rows = np.zeros(part, SAMPLE)
        rows["id"] = number * part + 1 + np.arange(part)
        rows["action"] = draw.integers(0, 3, part)
        rows["world"] = memory.world_indices([WORLDS[number * part >= PLUS * CAPACITY]])[0]
        images = np.zeros((part, *IMAGE_SHAPE), np.uint8)
        images.reshape(part, -1)[:, :15] = draw.integers(0, 256, (part, 15), np.uint8)
        memory.append(rows, images)
        discard(Situation(memory, number + 1, config, network, seed=seed))
    return float(np.mean(memory.rows["world"] == memory.world_indices(["plus"])[0]))


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("normm", 0.0),
        ("quotas", 0.0),
        ("reservoir", PLUS / (PLUS + MINUS)),
        ("quotas-reservoir", PLUS / (PLUS + MINUS)),
        ("random", np.exp(-MINUS)),
        ("half", 0.5 * PLUS / (PLUS + MINUS)),
        ("worlds", 0.5),
    ],
)
def test_so_much_of_plus_is_left_after_minus(name: str, expected: float) -> None:
    """Of nothing like another, chance and age alone decide."""
    shares = [shares_after_minus(name, seed) for seed in range(6)]
    deviation = np.sqrt(expected * (1 - expected) / CAPACITY / len(shares))
    assert np.mean(shares) == pytest.approx(expected, abs=4 * deviation + 0.005)
