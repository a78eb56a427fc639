"""Strategies that give each sample a worth, and the quotas of worlds, against loops."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from builders import FakePredictor, fake_values, fill_store, make_images
from hypothesis import given, settings
from hypothesis import strategies as st

from shared.config import MemoryConfig
from shared.rl.memory import ReplayMemory
from shared.rl.retention.least_worth import equal_quotas
from shared.rl.retention.strategy import Discard, Situation, chances, discard

FAST = settings(deadline=None, max_examples=80, derandomize=True)
CAPACITY, SEED = 30, 5


def memory_of(rewards: list[int]) -> ReplayMemory:
    """Samples with these rewards, in tenths."""
    memory = ReplayMemory(CAPACITY)
    ids = [2 * i + 1 for i in range(len(rewards))]
    fill_store(
        memory, ids, [i % 3 for i in ids], [r / 10 for r in rewards], make_images(len(ids), seed=4)
    )
    return memory


def reduce(memory: ReplayMemory, strategy: str, version: int = 1) -> Discard:
    config = MemoryConfig(capacity=CAPACITY, strategy=strategy)
    done = discard(Situation(memory, 1, config, FakePredictor(version), seed=SEED))
    memory.check_valid()
    return done


def naive_errors(memory: ReplayMemory, version: int) -> list[float]:
    images = memory.images(np.arange(len(memory)))
    return [
        float(row["reward"]) - fake_values(image.tobytes(), version)[row["action"]]
        for row, image in zip(memory.rows, images, strict=True)
    ]


def first_of(worth: list[float], memory: ReplayMemory) -> list[int]:
    """Ids of the least worth, of equal ones the older, down to 29."""
    order = sorted(range(len(worth)), key=lambda i: (worth[i], i))
    return sorted(int(memory.ids[i]) for i in order[: len(worth) - 29])


rewards = st.lists(st.integers(-10, 10), min_size=31, max_size=45)


@FAST
@given(rewards, st.integers(1, 3))
def test_surprise_removes_what_is_predicted_best(tenths: list[int], version: int) -> None:
    memory = memory_of(tenths)
    expected = first_of([abs(e) for e in naive_errors(memory, version)], memory)
    assert reduce(memory, "surprise", version).ids.tolist() == expected


def test_of_equal_surprise_the_older_goes() -> None:
    memory = ReplayMemory(CAPACITY)
    images = np.repeat(make_images(1), 33, axis=0)
    fill_store(memory, range(1, 34), [1] * 33, [0.25] * 33, images)
    assert reduce(memory, "surprise").ids.tolist() == [1, 2, 3, 4]


@FAST
@given(rewards)
def test_loss_reservoir_weighs_chances_with_the_loss(tenths: list[int]) -> None:
    memory = memory_of(tenths)
    drawn = [float(u) for u in chances(SEED, memory.ids)]
    pairs = zip(drawn, naive_errors(memory, 1), strict=True)
    keys = [math.log(u) / (error**2 + 0.001) for u, error in pairs]
    expected = first_of(keys, memory)
    assert reduce(memory, "loss-reservoir").ids.tolist() == expected


def test_predictions_are_renewed_for_other_weights_and_errors_follow_rewards() -> None:
    memory = memory_of([0] * 33)
    assert reduce(memory, "surprise", version=2).marked
    assert set(memory.rows["predicted_by"]) == {2}
    memory.rows["reward"] = 0.5
    fill_store(memory, [200, 201], [0, 1], [0.5, 0.5])
    expected = first_of([abs(e) for e in naive_errors(memory, 2)], memory)
    assert reduce(memory, "surprise", version=2).ids.tolist() == expected
    fill_store(memory, [300, 301], [0, 1])
    reduce(memory, "loss-reservoir", version=3)
    assert set(memory.rows["predicted_by"]) == {3}


def test_half_keeps_the_newest_and_the_best_chances_of_the_older() -> None:
    memory = memory_of([0] * 40)
    older, newest = memory.ids[:-14].copy(), memory.ids[-14:].tolist()
    best = sorted(older.tolist(), key=lambda i: float(chances(SEED, np.array([i], np.uint64))[0]))
    reduce(memory, "half")
    assert memory.ids.tolist() == sorted(best[-15:]) + newest


def test_random_draws_anew_at_each_discard() -> None:
    gone = []
    for draws in (0, 1):
        memory = memory_of([0] * 40)
        memory.kept["random_draws"] = draws
        gone.append(reduce(memory, "random").ids.tolist())
        assert memory.kept["random_draws"] == draws + 1
    assert gone[0] != gone[1]


@pytest.mark.parametrize(
    ("counts", "total", "kept"),
    [
        ([50, 50], 99, [49, 50]),
        ([100, 0, 7], 90, [83, 0, 7]),
        ([40, 40, 40], 100, [33, 33, 34]),
        ([10, 60, 60], 99, [10, 44, 45]),
        ([3, 2, 1], 6, [3, 2, 1]),
    ],
)
def test_quotas_of_worlds_are_as_equal_as_counts_allow(
    counts: list[int], total: int, kept: list[int]
) -> None:
    assert equal_quotas(np.array(counts), total) == kept


@FAST
@given(st.lists(st.integers(0, 3), min_size=31, max_size=60))
def test_in_each_world_the_best_chances_stay(worlds: list[int]) -> None:
    memory = memory_of([0] * len(worlds))
    memory.world_indices(["minus", "ring", "maze"])
    memory.rows["world"] = worlds
    before: dict[int, list[Any]] = {world: [] for world in range(4)}
    for number, world in zip(memory.ids, worlds, strict=True):
        before[world].append((float(chances(SEED, np.array([number]))[0]), int(number)))
    reduce(memory, "worlds")
    assert len(memory) == 29
    counts = np.bincount(memory.rows["world"], minlength=4)
    largest = max(counts)
    for world, own in before.items():
        kept = memory.ids[memory.rows["world"] == world].tolist()
        assert kept == sorted(i for _, i in sorted(own)[len(own) - counts[world] :])
        assert counts[world] == len(own) or counts[world] >= largest - 1
