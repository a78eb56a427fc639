"""Curves and seeds: block means, bands, bootstrap."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.report.statistics import (
    Band,
    band_between,
    band_of_blocks,
    block_means,
    bootstrap_difference,
    from_the_start,
    with_gaps,
)

values = st.floats(-1e3, 1e3)


@given(st.lists(st.one_of(st.just(math.nan), values), max_size=60), st.integers(1, 12))
def test_block_means_against_a_loop(heights: list[float], size: int) -> None:
    expected = []
    for start in range(0, len(heights) - size + 1, size):
        block = [value for value in heights[start : start + size] if not math.isnan(value)]
        if block:
            expected.append((float(start + size), sum(block) / len(block)))
    numbers = np.arange(1.0, len(heights) + 1)
    x, y = block_means(numbers, np.array(heights, np.float64), size)
    np.testing.assert_array_equal(x, [place for place, _ in expected])
    np.testing.assert_allclose(y, [mean for _, mean in expected], atol=1e-9)


def test_a_band_holds_all_seeds_wherever_they_have_values() -> None:
    first = (np.array([10.0, 20.0]), np.array([1.0, 5.0]))
    second = (np.array([10.0, 20.0, 30.0]), np.array([3.0, 1.0, 9.0]))
    third = (np.array([20.0]), np.array([2.0]))
    band = band_of_blocks([first, second, third])
    np.testing.assert_array_equal(band.x, [10, 20, 30])
    np.testing.assert_array_equal(band.low, [1, 1, 9])
    np.testing.assert_array_equal(band.median, [2, 2, 9])
    np.testing.assert_array_equal(band.high, [3, 5, 9])
    assert band.seeds == 3


def test_a_band_between_covers_what_all_seeds_cover() -> None:
    first = (np.array([0.0, 10.0]), np.array([0.0, 10.0]))
    second = (np.array([2.0, 4.0, 12.0]), np.array([4.0, 4.0, 20.0]))
    band = band_between([first, second])
    np.testing.assert_array_equal(band.x, [2, 4, 10])
    np.testing.assert_allclose(band.low, [2, 4, 10])
    np.testing.assert_allclose(band.high, [4, 4, 16])


def test_a_band_of_nothing_is_empty() -> None:
    nothing = (np.zeros(0), np.zeros(0))
    assert len(band_of_blocks([nothing]).x) == 0


def test_long_stretches_without_values_become_gaps() -> None:
    x = np.array([1.0, 2.0, 9.0, 10.0])
    band = with_gaps(Band(x, x, x, x, 1), 3.0)
    np.testing.assert_array_equal(band.x, [1, 2, 5.5, 9, 10])
    np.testing.assert_array_equal(band.median, [1, 2, math.nan, 9, 10])


def test_a_band_can_be_counted_from_its_start() -> None:
    x = np.array([1510.0, 1520.0])
    band = from_the_start(Band(x, x, x, x, 1), 1501.0)
    np.testing.assert_array_equal(band.x, [10, 20])
    np.testing.assert_array_equal(band.median, x)


@given(
    st.lists(values, min_size=2, max_size=6),
    st.lists(values, min_size=2, max_size=6),
    st.integers(0, 2**32 - 1),
)
def test_bootstrap_against_a_loop(ours: list[float], theirs: list[float], seed: int) -> None:
    count = 50
    draw = np.random.default_rng(seed)
    picks = [draw.integers(0, len(group), (count, len(group))) for group in (ours, theirs)]
    found = []
    for i in range(count):
        mine = sum(ours[k] for k in picks[0][i]) / len(ours)
        other = sum(theirs[k] for k in picks[1][i]) / len(theirs)
        found.append(mine - other)
    found.sort()

    def quantile(part: float) -> float:
        place = part * (count - 1)
        low = int(place)
        return found[low] + (place - low) * (found[min(low + 1, count - 1)] - found[low])

    result = bootstrap_difference(
        np.array(ours), np.array(theirs), np.random.default_rng(seed), count
    )
    assert result.mean == pytest.approx(sum(ours) / len(ours) - sum(theirs) / len(theirs), abs=1e-9)
    assert result.low == pytest.approx(quantile(0.025), abs=1e-6)
    assert result.high == pytest.approx(quantile(0.975), abs=1e-6)


def test_seeds_that_never_differ_are_sure_of_their_difference() -> None:
    draw = np.random.default_rng(1)
    result = bootstrap_difference(np.full(3, 2.0), np.full(4, 5.0), draw)
    assert (result.mean, result.low, result.high) == (-3.0, -3.0, -3.0)
    assert result.sure


def test_equal_groups_are_not_sure() -> None:
    group = np.array([1.0, 2.0, 3.0])
    result = bootstrap_difference(group, group, np.random.default_rng(1))
    assert result.mean == 0.0
    assert result.low < 0.0 < result.high
    assert not result.sure


@pytest.mark.parametrize(
    ("seeds", "least", "most"), [(2, 0.25, 0.45), (3, 0.15, 0.3), (5, 0.08, 0.2), (8, 0.0, 0.13)]
)
def test_intervals_of_few_seeds_are_too_narrow(seeds: int, least: float, most: float) -> None:
    """Of 100 differences between equal groups 5 should be sure; why few seeds are a hint only."""
    draw = np.random.default_rng(0)
    sure = [
        bootstrap_difference(*draw.normal(size=(2, seeds)), draw, 1000).sure for _ in range(600)
    ]
    assert least < np.mean(sure) < most


def test_one_seed_tells_nothing_about_spread() -> None:
    with pytest.raises(ValueError, match="expected at least 2 seeds each, got 1 and 3"):
        bootstrap_difference(np.ones(1), np.ones(3), np.random.default_rng(1))
