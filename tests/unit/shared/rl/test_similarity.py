"""Candidate marking by brute force (A30, E1, E23)."""

from __future__ import annotations

from typing import Literal

import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from shared.rl import similarity
from shared.rl.similarity import similar_to_newer

Rule = Literal["paper", "cover"]
RULES: tuple[Rule, ...] = ("paper", "cover")
FAST = settings(deadline=None, max_examples=60, derandomize=True)


def descriptors(n: int, flips: int, seed: int) -> np.ndarray:
    """n descriptors that differ from one of a few patterns in up to `flips` bits."""
    rng = np.random.default_rng([seed, n, flips])
    patterns = rng.integers(0, 2, (3, 120))
    bits = patterns[rng.integers(0, 3, n)]
    for row in bits:
        flipped = rng.choice(120, rng.integers(0, flips + 1), replace=False)
        row[flipped] ^= 1
    return np.packbits(bits.astype(bool), axis=1).reshape(n, 15)


def brute_force(given_descriptors: np.ndarray, bits: int, rule: Rule) -> list[bool]:
    return oracles.marks([row.tobytes() for row in given_descriptors], bits, rule)


@FAST
@given(
    n=st.integers(0, 60),
    flips=st.integers(0, 12),
    bits=st.sampled_from([0, 1, 2, 3, 4, 6, 7, 8, 119, 120]),
    rule=st.sampled_from(RULES),
    seed=st.integers(0, 10**6),
    rows=st.sampled_from([1, 2, 7, 512]),
    newer=st.sampled_from([1, 5, 16, 4096]),
    step=st.sampled_from([1, 4, 64]),
)
def test_marks_equal_brute_force_whatever_the_block_size(
    n: int, flips: int, bits: int, rule: Rule, seed: int, rows: int, newer: int, step: int
) -> None:
    given_descriptors = descriptors(n, flips, seed)
    with pytest.MonkeyPatch.context() as patch:
        for name, size in (("ROWS", rows), ("NEWER", newer), ("STEP", step)):
            patch.setattr(similarity, name, size)
        found = similar_to_newer(given_descriptors, bits, rule)
    assert found.dtype == np.bool_
    assert list(found) == brute_force(given_descriptors, bits, rule)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("around", [-1, 0, 1])
def test_marks_equal_brute_force_around_a_block_boundary(rule: Rule, around: int) -> None:
    rows = similarity.ROWS
    given_descriptors = descriptors(rows + around, flips=40, seed=1)
    found = similar_to_newer(given_descriptors, 8, rule)
    assert list(found) == brute_force(given_descriptors, 8, rule)
    assert 0 < found.sum() < rows - 1


@pytest.mark.parametrize("rule", RULES)
def test_the_only_likeness_may_lie_blocks_away(rule: Rule) -> None:
    rng = np.random.default_rng(2)
    given_descriptors = rng.integers(0, 256, (similarity.ROWS * 10, 15), np.uint8)
    given_descriptors[-1] = given_descriptors[3]
    found = similar_to_newer(given_descriptors, 1, rule)
    assert list(np.flatnonzero(found)) == [3]


@pytest.mark.parametrize("rule", RULES)
def test_the_library_meets_few_shapes_whatever_the_number_of_samples(rule: Rule) -> None:
    """It keeps half a megabyte for each shape of a product it has met."""
    rng = np.random.default_rng(3)
    patterns = rng.integers(0, 256, (500, 15), np.uint8)
    shapes: set[tuple[int, int]] = set()
    products = similarity._largest_products

    def noted(rows: Tensor, others: Tensor) -> np.ndarray:
        shapes.add((len(rows), len(others)))
        return products(rows, others)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(similarity, "_largest_products", noted)
        for n in (700, 5000, 9001, 9333):
            flips = np.packbits(rng.random((n, 120)) < 0.02, axis=1)
            marked = similar_to_newer(patterns[rng.integers(0, 500, n)] ^ flips, 2, rule)
            assert 0.01 < marked.mean() < 0.9
    assert len(shapes) <= 8
    assert {others for _, others in shapes} == {similarity.ROWS, similarity.NEWER}


@pytest.mark.parametrize("rule", RULES)
def test_no_sample_and_one_sample_have_no_newer_one(rule: Rule) -> None:
    assert similar_to_newer(np.zeros((0, 15), np.uint8), 8, rule).shape == (0,)
    assert list(similar_to_newer(np.zeros((1, 15), np.uint8), 120, rule)) == [False]


@pytest.mark.parametrize("rule", RULES)
def test_of_equal_samples_only_the_newest_is_kept(rule: Rule) -> None:
    assert list(similar_to_newer(np.full((5, 15), 7, np.uint8), 0, rule)) == [True] * 4 + [False]


@pytest.mark.parametrize("rule", RULES)
def test_a_distance_equal_to_the_threshold_is_similar(rule: Rule) -> None:
    """E1: at most the threshold, not beyond it."""
    pair = np.zeros((2, 15), np.uint8)
    pair[1, 0] = 0b11110000
    assert list(similar_to_newer(pair, 4, rule)) == [True, False]
    assert list(similar_to_newer(pair, 3, rule)) == [False, False]


def test_a_chain_erases_all_by_the_paper_rule_but_keeps_every_other_by_the_cover_rule() -> None:
    chain = np.zeros((5, 15), np.uint8)
    for i in range(5):
        chain[i, :1] = (1 << i) - 1  # neighbours differ in one bit
    assert list(similar_to_newer(chain, 1, "paper")) == [True] * 4 + [False]
    assert list(similar_to_newer(chain, 1, "cover")) == [False, True, False, True, False]


@FAST
@given(n=st.integers(1, 50), bits=st.integers(0, 8), seed=st.integers(0, 10**6))
def test_by_the_cover_rule_each_dropped_sample_has_a_kept_newer_likeness(
    n: int, bits: int, seed: int
) -> None:
    rows = [row.tobytes() for row in descriptors(n, 6, seed)]
    dropped = similar_to_newer(
        np.frombuffer(b"".join(rows), np.uint8).reshape(-1, 15), bits, "cover"
    )
    for i in np.flatnonzero(dropped):
        assert any(
            not dropped[j] and oracles.distance(rows[i], rows[j]) <= bits for j in range(i + 1, n)
        )
