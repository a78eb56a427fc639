"""Sentences by fixed rules, for and against the thesis."""

from __future__ import annotations

from dataclasses import replace

import pytest

from experiments.report import findings
from experiments.report.figures.drives import Compared
from experiments.report.statistics import Difference


@pytest.mark.parametrize(
    ("low", "mean", "high", "words"),
    [
        (-3.0, -2.0, -1.0, ["plus-rmm had fewer", "excludes 0", "so it is here"]),
        (1.0, 2.0, 3.0, ["plus-normm had fewer", "excludes 0", "here it is not"]),
        (-1.0, 0.5, 2.0, ["includes 0, so it is undecided", "The thesis found plus-rmm better"]),
        (-1.0, 0.0, 1.0, ["equally many"]),
    ],
)
def test_a_difference_is_told_whichever_way_it_goes(
    low: float, mean: float, high: float, words: list[str]
) -> None:
    pair = Compared("plus-rmm", "plus-normm", "plus", (8, 8), Difference(mean, low, high))
    told = findings.difference(pair, "plus-rmm")
    for word in words:
        assert word in told
    few = findings.difference(replace(pair, seeds=(8, 3)), "plus-rmm")
    assert ("only a hint" in few) == pair.difference.sure
    assert "The thesis" not in findings.difference(pair, None)
    assert "so it is here" not in few
    assert "here it is not" not in few
