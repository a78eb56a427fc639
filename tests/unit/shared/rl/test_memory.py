"""The replay memory against a plain list of dicts, after every operation (A27-A35, A44)."""

from __future__ import annotations

from functools import partial
from typing import Any
from unittest import mock

import numpy as np
import oracles
import pytest
from builders import FakePredictor, fake_values, fill_store, image_with, make_images
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from shared.config import MemoryConfig
from shared.rl import memory as memory_module
from shared.rl.memory import MIRROR, SAMPLE, ReplayMemory, SampleStore
from shared.rl.retention.rmm import candidates_by_action, force_candidates
from shared.rl.schedule import Moment
from shared.rl.turn import maintain


def snapshot(store: SampleStore) -> tuple[bytes, bytes, int]:
    """Everything that can be seen of a store from outside."""
    visible = store.rows.copy()
    visible["slot"] = 0
    return visible.tobytes(), store.images(np.arange(len(store))).tobytes(), len(store)


class MemoryMachine(RuleBasedStateMachine):
    """Random operations on a memory with blocks of 8 images, and on the model."""

    def __init__(self) -> None:
        super().__init__()
        self.patch = mock.patch.object(memory_module, "BLOCK", 8)
        self.patch.start()
        self.memory = ReplayMemory(12)
        self.model: list[dict[str, Any]] = []
        self.capacity = 12
        self.next_id = 1
        self.version = 1
        self.percent = 1

    def teardown(self) -> None:
        self.patch.stop()

    # --------------------------------------------------------------- changes

    @initialize(capacity=st.integers(3, 20))
    def begin(self, capacity: int) -> None:
        self.memory.set_capacity(capacity)
        self.capacity = capacity

    @rule(
        samples=st.lists(
            st.tuples(st.integers(1, 3), st.integers(0, 2), st.integers(-4, 4), st.integers(0, 5)),
            max_size=14,
        ),
        world=st.sampled_from(["plus", "minus"]),
    )
    def append(self, samples: list[tuple[int, int, int, int]], world: str) -> None:
        rows, images = np.zeros(len(samples), SAMPLE), []
        for row, (gap, action, reward, kind) in zip(rows, samples, strict=True):
            self.next_id += gap
            image = image_with(
                bytes(14) + bytes([(1 << kind) - 1]) + self.next_id.to_bytes(4, "big")
            )
            row["id"], row["action"], row["reward"] = self.next_id, action, reward / 4
            row["world"] = self.memory.world_indices([world])[0]
            row["episode"] = self.version
            images.append(image)
            self.model.append(
                {
                    "id": self.next_id,
                    "action": action,
                    "reward": reward / 4,
                    "image": image,
                    "world": world,
                    "episode": self.version,
                    "candidate": False,
                    "forced": False,
                }
            )
        shape = (len(samples), 50, 75)
        given_images = np.frombuffer(b"".join(images), np.uint8).reshape(shape).copy()
        self.memory.append(rows, given_images)
        given_images[:] = 99  # the memory has its own copy

    @precondition(lambda self: self.model)
    @rule(data=st.data())
    def remove(self, data: st.DataObject) -> None:
        ids = data.draw(st.lists(st.sampled_from([s["id"] for s in self.model]), max_size=6))
        self.memory.remove(np.array(ids, np.uint64))
        self.model = [s for s in self.model if s["id"] not in ids]

    @precondition(lambda self: self.model)
    @rule(data=st.data())
    def set_rewards(self, data: st.DataObject) -> None:
        known = [s["id"] for s in self.model]
        ids = data.draw(st.lists(st.sampled_from(known), max_size=6, unique=True))
        rewards = data.draw(
            st.lists(st.floats(-1, 1, width=32), min_size=len(ids), max_size=len(ids))
        )
        self.memory.set_rewards(np.array(ids, np.uint64), np.array(rewards, np.float32))
        for ident, reward in zip(ids, rewards, strict=True):
            next(s for s in self.model if s["id"] == ident)["reward"] = reward

    @rule(capacity=st.integers(3, 40))
    def set_capacity(self, capacity: int) -> None:
        self.memory.set_capacity(capacity)
        self.capacity = capacity

    @precondition(lambda self: self.model)
    @rule(data=st.data())
    def force(self, data: st.DataObject) -> None:
        ids = data.draw(st.lists(st.sampled_from([s["id"] for s in self.model]), max_size=3))
        force_candidates(self.memory, np.array(ids, np.uint64))
        for s in self.model:
            if s["id"] in ids:
                s["forced"] = s["candidate"] = True

    @rule()
    def new_weights(self) -> None:
        self.version += 1

    @rule(
        strategy=st.sampled_from(["rmm", "rmm", "normm"]),
        marking=st.sampled_from(["paper", "cover"]),
        equalise=st.booleans(),
    )
    def end_of_episode(self, strategy: Any, marking: Any, equalise: bool) -> None:
        """Discard, and equalise when due."""
        config = MemoryConfig(strategy=strategy, rule=marking, equalise_every=int(equalise))
        predictor: Any = FakePredictor(self.version)
        done = maintain(self.memory, Moment(1), config, predictor, seed=1)
        samples = [
            oracles.Sample(s["id"], s["action"], s["image"][:15], s["candidate"], s["forced"])
            for s in self.model
        ]
        expected = oracles.discard(
            samples, self.capacity, self.percent, strategy=strategy, rule=marking
        )
        assert [int(i) for i in done.discarded.ids] == expected.removed
        kept = {s.id: s for s in samples}
        self.model = [s for s in self.model if s["id"] in kept]
        for s in self.model:
            s["candidate"] = kept[s["id"]].candidate
        self.percent = done.discarded.told["threshold_percent"]
        assert self.percent == expected.percent
        assert len(self.memory) <= self.capacity
        assert done.equalised == (equalise and bool(self.model))
        if done.equalised:
            for s in self.model:
                value = fake_values(s["image"], self.version)[s["action"]]
                s["reward"] = 0.7 * s["reward"] + 0.3 * value

    # --------------------------------------------------------------- refusals

    @rule(
        fault=st.sampled_from(["id", "order", "action", "reward", "NaN", "shape", "dtype", "count"])
    )
    def refused_append(self, fault: str) -> None:
        rows, images = np.zeros(2, SAMPLE), make_images(2)
        rows["id"] = [self.next_id + 1, self.next_id + 2]
        if fault == "id":
            rows["id"] = [self.model[-1]["id"] if self.model else 5, 5]
        elif fault == "order":
            rows["id"] = rows["id"][::-1].copy()
        elif fault == "action":
            rows["action"][1] = 3
        elif fault in ("reward", "NaN"):
            rows["reward"][1] = {"reward": -1.0001, "NaN": np.nan}[fault]
        else:
            images = {
                "shape": images[:, :, :74],
                "dtype": images.astype(np.int16),
                "count": images[:1],
            }[fault]
        before = snapshot(self.memory)
        with pytest.raises(ValueError, match=r"insertion|action|reward|images"):
            self.memory.append(rows, images)
        assert snapshot(self.memory) == before

    @rule(data=st.data(), what=st.sampled_from(["remove", "set_rewards", "force_candidates"]))
    def unknown_id(self, data: st.DataObject, what: str) -> None:
        known = [s["id"] for s in self.model][:2]
        missing = data.draw(st.sampled_from([0, self.next_id + 1, 2**63]))
        ids = np.array([*known, missing], np.uint64)
        more = [np.zeros(len(ids), np.float32)] if what == "set_rewards" else []
        before = snapshot(self.memory)
        forcing = partial(force_candidates, self.memory)
        change = forcing if what == "force_candidates" else getattr(self.memory, what)
        with pytest.raises(KeyError):
            change(ids, *more)
        assert snapshot(self.memory) == before

    @precondition(lambda self: self.model)
    @rule(reward=st.sampled_from([1.5, -1.01, float("nan"), float("inf")]))
    def refused_reward(self, reward: float) -> None:
        before = snapshot(self.memory)
        with pytest.raises(ValueError, match="reward"):
            self.memory.set_rewards(self.memory.ids[:1], np.array([reward], np.float32))
        assert snapshot(self.memory) == before

    @rule(capacity=st.integers(-3, 0))
    def refused_capacity(self, capacity: int) -> None:
        with pytest.raises(ValueError, match="capacity"):
            self.memory.set_capacity(capacity)
        assert self.memory.capacity == self.capacity

    # --------------------------------------------------------------- always

    @invariant()
    def equals_the_model(self) -> None:
        memory, rows = self.memory, self.memory.rows
        memory.check_valid()
        assert len(memory) == len(self.model)
        for name in ("id", "action", "episode", "candidate", "forced"):
            assert rows[name].tolist() == [s[name] for s in self.model]
        assert rows["reward"].tolist() == pytest.approx([s["reward"] for s in self.model], abs=1e-5)
        assert [memory.worlds[w] for w in rows["world"]] == [s["world"] for s in self.model]
        images = memory.images(np.arange(len(memory)))
        assert [i.tobytes() for i in images] == [s["image"] for s in self.model]
        assert memory.by_action() == [sum(s["action"] == a for s in self.model) for a in range(3)]
        assert candidates_by_action(memory) == [
            sum(s["candidate"] and s["action"] == a for s in self.model) for a in range(3)
        ]
        # rounding differs from the model's; both go on from the same numbers
        for s, reward in zip(self.model, rows["reward"].tolist(), strict=True):
            s["reward"] = reward


TestMemoryMachine = MemoryMachine.TestCase
TestMemoryMachine.settings = settings(
    deadline=None, max_examples=150, stateful_step_count=40, derandomize=True
)


# ------------------------------------------------------------------------- single facts


def test_images_come_back_in_the_order_asked_for_and_are_copies() -> None:
    store = SampleStore()
    fill_store(store, [3, 5, 9], [0, 1, 2])
    asked = store.images(np.array([2, 0, 2]))
    assert [a.tobytes() for a in asked] == [make_images(1, seed=s)[0].tobytes() for s in (9, 3, 9)]
    asked[:] = 0
    assert store.images(np.array([0])).any()


def test_blocks_of_the_real_size_hold_what_crosses_their_boundary() -> None:
    store, block = SampleStore(), memory_module.BLOCK
    n = block + 2
    images = np.zeros((n, 50, 75), np.uint8)
    images[:, 0, 0], images[:, 0, 1] = np.arange(n) % 251, np.arange(n) // 251
    fill_store(store, range(1, n + 1), [0] * n, images=images)
    assert (store.images(np.arange(n)) == images).all()
    store.remove(np.arange(1, n, dtype=np.uint64))
    fill_store(store, [n + 1], [1], images=images[:1])
    assert (store.images(np.array([0, 1])) == images[[n - 1, 0]]).all()
    store.check_valid()


def test_slots_are_used_again() -> None:
    with mock.patch.object(memory_module, "BLOCK", 4):
        store = SampleStore()
        for first in range(1, 60, 3):
            fill_store(store, range(first, first + 3), [0, 1, 2])
            store.remove(store.ids[: max(len(store) - 3, 0)])
            store.check_valid()
        assert len(store._blocks) == 2


def test_an_empty_store_answers_everything() -> None:
    store = SampleStore()
    store.append(np.zeros(0, MIRROR), np.zeros((0, 50, 75), np.uint8))
    store.remove(np.zeros(0, np.uint64))
    store.check_valid()
    assert (len(store), store.by_action()) == (0, [0, 0, 0])
    assert store.images(np.zeros(0, np.int64)).shape == (0, 50, 75)
    with pytest.raises(KeyError):
        store.ranks(np.array([1], np.uint64))


@pytest.mark.parametrize("ids", [[7], [5, 8], [8, 8], [9, 8]])
def test_insertion_numbers_grow_from_sample_to_sample_or_nothing_is_stored(ids: list[int]) -> None:
    store = SampleStore()
    fill_store(store, [3, 7], [0, 1])
    before = snapshot(store)
    with pytest.raises(ValueError, match="must grow"):
        fill_store(store, ids, [0] * len(ids))
    assert snapshot(store) == before


def test_insertion_numbers_beyond_32_bits_are_kept_exactly() -> None:
    store = SampleStore()
    fill_store(store, [2**40, 2**53 + 1, 2**53 + 2, 2**62], [0, 1, 2, 0], images=make_images(4))
    assert list(store.ranks(np.array([2**53 + 2, 2**62], np.uint64))) == [2, 3]
    store.remove(np.array([2**53 + 1], np.uint64))
    assert [int(i) for i in store.ids] == [2**40, 2**53 + 2, 2**62]


@pytest.mark.parametrize(
    ("break_it", "named"),
    [
        (lambda m: m.rows["id"].__setitem__(1, 1), "grow"),
        (lambda m: m.rows["slot"].__setitem__(1, m.rows["slot"][0]), "slot"),
        (lambda m: m.rows["action"].__setitem__(0, 7), "actions"),
        (lambda m: m.rows["reward"].__setitem__(0, np.nan), "rewards"),
        (lambda m: m.rows["forced"].__setitem__(0, True), "forced"),
        (lambda m: m.rows["candidate"].__setitem__(0, True), "version"),
        (lambda m: m.rows["marked_by"].__setitem__(0, 1), "descriptor"),
        (lambda m: m.rows["world"].__setitem__(0, 9), "worlds"),
    ],
)
def test_each_broken_invariant_is_named(break_it: Any, named: str) -> None:
    memory = ReplayMemory(5)
    fill_store(memory, [1, 2, 3], [0, 1, 2])
    memory.check_valid()
    break_it(memory)
    with pytest.raises(AssertionError, match=named):
        memory.check_valid()
