"""Statistics of compared seeds against naive ones (docs/comparison.md)."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from experiments.verdicts import FLIPS, Paired, holm, interquartile_mean, log_rates, max_t, paired

FAST = settings(deadline=None, max_examples=40, derandomize=True)
seeds = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=8)


def test_rates_without_a_bump_have_a_logarithm() -> None:
    found = log_rates(np.array([0.0, 25.0]), np.array([25600.0, 25600.0]))
    assert found.tolist() == [math.log(0.5 / 25600), math.log(25.5 / 25600)]


@FAST
@given(seeds)
def test_the_interval_is_that_of_the_t_distribution(values: list[float]) -> None:
    ours = np.array(values)
    theirs = np.linspace(0.0, 1.0, len(values))
    found = paired(ours, theirs)
    test = stats.ttest_rel(ours, theirs)
    low, high = test.confidence_interval(0.95)
    assert math.log(found.ratio) == pytest.approx(np.mean(ours - theirs), abs=1e-9)
    assert math.log(found.low) == pytest.approx(low, abs=1e-9)
    assert math.log(found.high) == pytest.approx(high, abs=1e-9)
    one_sided = stats.ttest_rel(ours, theirs, alternative="less").confidence_interval(0.95).high
    assert math.log(found.bound) == pytest.approx(one_sided, abs=1e-9)


@FAST
@given(seeds)
def test_the_permutation_test_tries_all_signs(values: list[float]) -> None:
    ours, theirs = np.array(values), np.zeros(len(values))
    signs = itertools.product((1.0, -1.0), repeat=len(values))
    sums = [abs(sum(s * v for s, v in zip(each, values, strict=True))) for each in signs]
    expected = np.mean([value >= abs(sum(values)) - 1e-9 for value in sums])
    assert paired(ours, theirs).p == pytest.approx(expected, abs=2.0 / len(sums))


def test_many_seeds_draw_their_signs_and_count_the_true_ones() -> None:
    ours = np.full(30, -1.0)
    assert 1.0 / FLIPS <= paired(ours + np.linspace(0, 0.1, 30), np.zeros(30)).p < 0.001


def made(low: float, high: float, bound: float = 1.0) -> Paired:
    return Paired(math.sqrt(low * high), low, high, bound, 0.5, 8, 8)


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [
        (0.3, 0.9, "better"),
        (1.1, 4.0, "worse"),
        (0.7, 1.4, "equal"),
        (0.7, 0.9, "equal"),
        (0.5, 1.2, "undecided"),
        (0.9, 1.6, "undecided"),
    ],
)
def test_verdicts_follow_from_the_interval(low: float, high: float, verdict: str) -> None:
    assert made(low, high).verdict == verdict


def test_not_inferior_is_surely_less_than_one_and_a_half_times() -> None:
    assert made(0.5, 2.0, bound=1.49).not_inferior
    assert not made(0.5, 2.0, bound=1.51).not_inferior


@FAST
@given(st.dictionaries(st.text("abc", min_size=1), st.floats(0.0, 1.0), min_size=1, max_size=5))
def test_holm_never_makes_a_p_value_smaller_and_keeps_their_order(p: dict[str, float]) -> None:
    found = holm(p)
    assert found.keys() == p.keys()
    names = sorted(p, key=lambda name: p[name])
    assert all(p[name] <= found[name] <= 1.0 for name in p)
    assert [found[name] for name in names] == sorted(found.values())
    assert found[names[0]] == pytest.approx(min(1.0, len(p) * p[names[0]]))
    assert found[names[-1]] >= p[names[-1]]


def test_max_t_of_one_comparison_is_its_permutation_test_of_t() -> None:
    values = np.array([0.4, 1.2, -0.3, 0.8, 0.9])
    observed = abs(stats.ttest_1samp(values, 0.0).statistic)
    signs = itertools.product((1.0, -1.0), repeat=5)
    t = [abs(stats.ttest_1samp(values * np.array(each), 0.0).statistic) for each in signs]
    expected = np.mean([each >= observed - 1e-9 for each in t])
    assert max_t({"a": values}) == {"a": pytest.approx(expected)}


def test_more_comparisons_make_each_less_sure() -> None:
    draw = np.random.default_rng(0)
    rows = {name: draw.normal(0.8, 1.0, 8) for name in "abcdef"}
    alone = max_t({"a": rows["a"]})["a"]
    assert max_t(rows)["a"] >= alone


def test_the_middle_half_counts() -> None:
    assert interquartile_mean(np.array([0.0, 1.0, 2.0, 1000.0])) == 1.5


def test_so_many_seeds_would_decide() -> None:
    """With as many, drawn alike, the interval does decide."""
    draw = np.random.default_rng(1)
    few = draw.normal(-0.5, 1.0, 6)
    needed = paired(few, np.zeros(6)).needed
    spread = (few - few.mean()) / few.std(ddof=1)
    many = np.resize(spread, needed) * few.std(ddof=1) + few.mean()
    assert 6 < needed < 1000
    assert paired(many, np.zeros(needed)).verdict != "undecided"


@pytest.mark.parametrize("sizes", [(1, 1), (3, 4)])
def test_seeds_that_cannot_be_paired_are_refused(sizes: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="expected as many seeds"):
        paired(np.zeros(sizes[0]), np.zeros(sizes[1]))
