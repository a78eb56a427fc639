"""Coverage of descriptors, of poses and of gradients against loops over all pairs."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from builders import FakePredictor, fill_store, images_with
from hypothesis import given, settings
from hypothesis import strategies as st

from shared.config import MemoryConfig
from shared.rl.draws import generator
from shared.rl.memory import ReplayMemory
from shared.rl.retention.most_alike import (
    COVERAGE_POSE,
    FAR,
    PLANES,
    UNITS,
    hamming,
    older_of_most_alike,
    sides,
)
from shared.rl.retention.strategy import Situation, discard

FAST = settings(deadline=None, max_examples=30, derandomize=True)
CAPACITY = 30


def naive(distance: Callable[[int, int], float], n: int, count: int) -> list[int]:
    """The older of the nearest pair goes, of several that whose older sample is the oldest."""
    alive, gone = list(range(n)), []
    for _ in range(count):
        pairs = [(distance(i, j), i) for i in alive for j in alive if i < j]
        gone.append(min(pairs)[1])
        alive.remove(gone[-1])
    return sorted(gone)


def differing(a: bytes, b: bytes) -> int:
    return sum((x ^ y).bit_count() for x, y in zip(a, b, strict=True))


def memory_of(fronts: list[bytes]) -> ReplayMemory:
    memory = ReplayMemory(CAPACITY)
    ids = range(1, len(fronts) + 1)
    fill_store(memory, ids, [i % 3 for i in ids], images=images_with(fronts))
    return memory


def removed(memory: ReplayMemory, strategy: str, network: Any = None, seed: int = 5) -> list[int]:
    """Ranks that a discard removes."""
    before = memory.ids.copy()
    config = MemoryConfig(capacity=CAPACITY, strategy=strategy)
    done = discard(Situation(memory, 1, config, network or FakePredictor(), seed=seed))
    memory.check_valid()
    return [int(i) for i in np.searchsorted(before, done.ids)]


@FAST
@given(st.lists(st.integers(0, 255), min_size=31, max_size=45), st.sampled_from([1, 2**64 + 1]))
def test_coverage_removes_the_older_of_the_most_alike(numbers: list[int], factor: int) -> None:
    fronts = [(factor * number).to_bytes(15, "big") for number in numbers]
    n = len(fronts)
    expected = naive(lambda i, j: differing(fronts[i], fronts[j]), n, n - 29)
    assert removed(memory_of(fronts), "coverage") == expected


@pytest.mark.parametrize("seed", range(3))
def test_more_than_one_block_gives_the_same(seed: int) -> None:
    n, count = 1100, 300
    drawn = np.random.default_rng(seed).integers(0, 256, (n, 2), np.uint8)
    bits = np.unpackbits(drawn, axis=1).astype(int)
    pairs = (bits[:, np.newaxis] != bits).sum(axis=2).astype(float)
    pairs[np.tri(n, dtype=bool)] = np.inf
    expected = []
    for _ in range(count):
        expected.append(int(np.argmin(pairs)) // n)
        pairs[expected[-1]], pairs[:, expected[-1]] = np.inf, np.inf
    assert older_of_most_alike(hamming(drawn), n, count).tolist() == sorted(expected)


def test_a_sample_whose_nearest_has_gone_is_as_far_as_its_next() -> None:
    numbers = [0, 0b1111, 0b111111, 0xFFFF00, 0xFFF800 | 0b11]
    packed = np.array([list(number.to_bytes(3, "big")) for number in numbers], np.uint8)
    distances = hamming(packed)(np.arange(5), 0)
    assert [distances[i, j] for i, j in ((1, 2), (0, 1), (0, 2))] == [2, 4, 6]
    assert distances[3, 4] == 5
    assert older_of_most_alike(hamming(packed), 5, 2).tolist() == [1, 3]


def test_coverage_describes_anew_what_other_weights_described() -> None:
    memory, network = memory_of([bytes([i] * 15) for i in range(32)]), FakePredictor()
    removed(memory, "coverage", network)
    assert network.described == [32]
    fill_store(memory, [50, 51], [0, 0])
    removed(memory, "coverage", network)
    assert network.described == [32, 2]
    network.version = 2
    fill_store(memory, [60, 61], [0, 0])
    removed(memory, "coverage", network)
    assert network.described == [32, 2, 31]


poses = st.tuples(
    st.integers(0, 1), st.integers(0, 3), st.integers(0, 3), st.sampled_from([-7.0, -3.0, 0.0, 3.0])
)


@FAST
@given(st.lists(poses, min_size=31, max_size=40))
def test_coverage_of_poses_removes_the_older_of_the_nearest(
    given_poses: list[tuple[int, int, int, float]],
) -> None:
    n = len(given_poses)
    memory = memory_of([bytes(1)] * n)
    memory.world_indices(["minus"])
    for row, pose in zip(memory.rows, given_poses, strict=True):
        row["world"], row["x_m"], row["y_m"], row["heading_rad"] = pose

    def distance(i: int, j: int) -> float:
        (world, x, y, heading), (other, x2, y2, heading2) = given_poses[i], given_poses[j]
        if world != other:
            return float(FAR)
        turned = math.acos(max(-1.0, min(1.0, math.cos(heading - heading2))))
        return math.hypot(x - x2, y - y2) + 0.5 * turned

    there = Situation(memory, 1, MemoryConfig(), FakePredictor(), seed=1)
    found = COVERAGE_POSE.distances(there)(np.arange(n), 0)
    every = [[distance(i, j) for j in range(n)] for i in range(n)]
    assert found == pytest.approx(np.array(every), rel=1e-9, abs=1e-7)
    expected = naive(lambda i, j: float(found[i, j]), n, n - 29)
    assert removed(memory, "coverage-pose") == expected


def test_other_worlds_are_never_near() -> None:
    memory = memory_of([bytes(1)] * 31)
    memory.world_indices(["minus"])
    memory.rows["x_m"] = 10.0 * np.arange(31)
    memory.rows["x_m"][[0, 1]], memory.rows["world"][0] = 5.0, 1
    memory.rows["x_m"][[20, 21]] = 200.0, 209.0
    memory.rows["x_m"][[10, 11]] = 100.0, 101.0
    assert removed(memory, "coverage-pose") == [10, 20]


def test_sides_tell_the_angle_between_gradients() -> None:
    planes = generator(3, "gradients").standard_normal((UNITS, 4096))
    draw = np.random.default_rng(1)
    hidden = draw.random((2, UNITS)).astype(np.float32)
    hidden[1, :60] = 0.0
    errors = np.array([0.5, 0.01], np.float32)
    found = np.unpackbits(sides(hidden, errors, planes), axis=1)
    cosine = hidden[0] @ hidden[1] / np.linalg.norm(hidden[0]) / np.linalg.norm(hidden[1])
    assert np.mean(found[0] != found[1]) == pytest.approx(math.acos(cosine) / math.pi, abs=0.03)
    opposite = np.unpackbits(sides(hidden, -errors, planes), axis=1)
    assert np.all(found != opposite)
    assert not sides(hidden, np.zeros(2, np.float32), planes).any()


@FAST
@given(st.lists(st.integers(0, 20), min_size=31, max_size=40))
def test_gradients_removes_the_older_of_the_most_alike(numbers: list[int]) -> None:
    n, network = len(numbers), FakePredictor()
    memory = memory_of([number.to_bytes(15, "little") for number in numbers])
    actions, rewards = memory.rows["action"].copy(), memory.rows["reward"].copy()
    images = memory.images(np.arange(n))
    planes = generator(5, "gradients").standard_normal((UNITS, PLANES))
    hashes = []
    for image, action, reward in zip(images, actions, rewards, strict=True):
        hidden, value = network.hidden(image[np.newaxis], np.array([action]))
        gradient = 2.0 * (value[0] - reward) * hidden[0].astype(float)
        bits = "".join("1" if gradient @ plane > 0.0 else "0" for plane in planes.T)
        hashes.append(int(bits, 2).to_bytes(8, "big"))
    expected = naive(lambda i, j: differing(hashes[i], hashes[j]), n, n - 29)
    assert removed(memory, "gradients") == expected
