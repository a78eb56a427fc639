"""Novelty, RMM without quotas and `mark_share` against loops."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest
from builders import FakePredictor, fill_store, images_with
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import BITS_OF_PERCENT

from shared.config import MemoryConfig
from shared.rl.memory import ReplayMemory
from shared.rl.retention.columns import renew_descriptors
from shared.rl.retention.rmm import STRATEGY, force_candidates, least_bits
from shared.rl.retention.strategy import Discard, Situation, discard

FAST = settings(deadline=None, max_examples=30, derandomize=True)
CAPACITY, PERCENT = 30, 3
Kinds = list[tuple[int, int]]
"""Action and descriptor's number of each sample, oldest first."""
kinds = st.lists(st.tuples(st.integers(0, 2), st.integers(0, 2047)), min_size=31, max_size=60)


def memory_of(given_kinds: Kinds) -> ReplayMemory:
    memory = ReplayMemory(CAPACITY)
    actions = [action for action, _ in given_kinds]
    images = images_with([number.to_bytes(15, "big") for _, number in given_kinds])
    fill_store(memory, range(len(actions)), actions, images=images)
    return memory


def reduce(memory: ReplayMemory, **config: Any) -> Discard:
    settings_ = MemoryConfig(capacity=CAPACITY, threshold_percent=PERCENT, **config)
    done = discard(Situation(memory, 1, settings_, FakePredictor(), seed=5))
    memory.check_valid()
    return done


def marked(given_kinds: Kinds, bits: int, *, by_older: bool = False) -> list[bool]:
    """Whether a newer (or older) sample of the same action differs in at most so many bits."""
    n = len(given_kinds)

    def alike(i: int, j: int) -> bool:
        (action, number), (other, number2) = given_kinds[i], given_kinds[j]
        return action == other and (number ^ number2).bit_count() <= bits

    others = [range(i) if by_older else range(i + 1, n) for i in range(n)]
    return [any(alike(i, j) for j in others[i]) for i in range(n)]


def oldest(own: list[int], candidate: list[bool], count: int) -> list[int]:
    """Candidates first, each kind oldest first."""
    return sorted(own, key=lambda i: (not candidate[i], i))[:count]


@FAST
@given(kinds)
def test_novelty_removes_what_looks_like_an_older_sample(given_kinds: Kinds) -> None:
    candidate = marked(given_kinds, BITS_OF_PERCENT[PERCENT], by_older=True)
    expected = []
    for action in range(3):
        own = [i for i, (a, _) in enumerate(given_kinds) if a == action]
        if 3 * len(own) > CAPACITY:
            expected += oldest(own, candidate, len(own) - 9)
    assert reduce(memory_of(given_kinds), strategy="novelty").ids.tolist() == sorted(expected)


@pytest.mark.parametrize(("strategy", "gone"), [("rmm", [0, 9]), ("novelty", [0, 10])])
def test_of_two_alike_rmm_removes_the_older_and_novelty_the_newer(
    strategy: str, gone: list[int]
) -> None:
    others = [(0, (2**i - 1) << 15) for i in range(10, 55, 5)]
    pair = [(0, 0), (0, 1)]
    rest = [(1, 0)] * 10 + [(2, 0)] * 10
    assert reduce(memory_of(others + pair + rest), strategy=strategy).ids.tolist() == gone


@FAST
@given(kinds)
def test_rmm_total_removes_the_oldest_candidates_of_all_actions(given_kinds: Kinds) -> None:
    n = len(given_kinds)
    candidate = marked(given_kinds, BITS_OF_PERCENT[PERCENT])
    memory = memory_of(given_kinds)
    done = reduce(memory, strategy="rmm-total")
    assert done.ids.tolist() == sorted(oldest(list(range(n)), candidate, n - 29))
    assert len(memory) == 29
    assert done.told["last_resort"] == max(0, n - 29 - sum(candidate))
    few = sum(candidate) <= 1
    assert done.told["threshold_percent"] == PERCENT + few


def test_rmm_total_searches_again_when_all_candidates_together_are_too_few() -> None:
    memory = memory_of([(i % 3, 0) for i in range(31)])
    assert reduce(memory, strategy="rmm-total", recompute_below=5).told["recomputed"]
    fill_store(memory, [40, 41], [0, 0])
    assert not reduce(memory, strategy="rmm-total", recompute_below=5).told["recomputed"]
    fill_store(memory, [50, 51], [0, 0])
    assert reduce(memory, strategy="rmm-total", recompute_below=25).told["recomputed"]


@FAST
@given(kinds, st.sampled_from([0.1, 0.5, 0.9, 1.0]))
def test_a_share_of_marks_takes_the_fewest_bits(given_kinds: Kinds, share: float) -> None:
    actions = [action for action, _ in given_kinds]
    own = [i for i, a in enumerate(actions) if 3 * actions.count(a) > CAPACITY]

    def found(bits: int) -> float:
        candidate = marked(given_kinds, bits)
        return sum(candidate[i] for i in own) / len(own)

    bits = next((b for b in range(120) if found(b) >= share), 120)
    memory = memory_of(given_kinds)
    everything = reduce(memory, strategy="rmm", mark_share=share, recompute_below=1)
    assert everything.told["recomputed"]
    candidate = marked(given_kinds, bits)
    assert memory.rows["candidate"].tolist() == [candidate[int(i)] for i in memory.ids]


@pytest.mark.parametrize("rule", ["paper", "cover"])
def test_the_fewest_bits_are_found_for_both_rules(rule: Literal["paper", "cover"]) -> None:
    memory = memory_of([(0, (1 << 3 * (i % 7)) - 1) for i in range(40)])
    config = MemoryConfig(capacity=30, mark_share=0.9, rule=rule)
    renew_descriptors(Situation(memory, 1, config, FakePredictor(), seed=5))
    own = np.ones(len(memory), np.bool_)

    def enough(bits: int) -> bool:
        similar = STRATEGY.similar(memory.rows["descriptor"], bits, rule)
        return bool(np.mean(similar | memory.rows["forced"]) >= config.mark_share)

    expected = next(b for b in range(121) if enough(b))
    assert expected > 0
    assert least_bits(memory, own, config, STRATEGY.similar) == expected
    force_candidates(memory, memory.ids)
    assert least_bits(memory, own, config, STRATEGY.similar) == 0
