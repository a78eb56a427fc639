"""Curves and seeds: block means, bands."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from experiments.report.statistics import Band, band_between, band_of_blocks, block_means, with_gaps

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
    np.testing.assert_array_equal(band.levels, [[1, 1, 9], [2, 2, 9], [3, 5, 9]])
    assert band.seeds == 3


def test_a_band_between_covers_what_all_seeds_cover() -> None:
    first = (np.array([0.0, 10.0]), np.array([0.0, 10.0]))
    second = (np.array([2.0, 4.0, 12.0]), np.array([4.0, 4.0, 20.0]))
    band = band_between([first, second])
    np.testing.assert_array_equal(band.x, [2, 4, 10])
    np.testing.assert_allclose(band.levels[[0, 2]], [[2, 4, 10], [4, 4, 16]])


def test_a_band_of_nothing_is_empty() -> None:
    nothing = (np.zeros(0), np.zeros(0))
    assert len(band_of_blocks([nothing]).x) == 0


def test_long_stretches_without_values_become_gaps() -> None:
    x = np.array([1.0, 2.0, 9.0, 10.0])
    band = with_gaps(Band(x, np.stack([x, x, x]), 1), 3.0)
    np.testing.assert_array_equal(band.x, [1, 2, 5.5, 9, 10])
    np.testing.assert_array_equal(band.levels[1], [1, 2, math.nan, 9, 10])
