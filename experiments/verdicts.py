"""What compared seeds tell: intervals, permutation tests, verdicts (docs/comparison.md).

All of it is about rates of bumps, compared seed by seed as differences of their logarithms. The
exponential of such a difference is the ratio of the rates: below 1 the first one bumps less.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy import stats

from shared.rl.draws import generator

Floats = npt.NDArray[np.float64]
Verdict = Literal["better", "worse", "equal", "undecided"]

LEVEL = 0.95
MARGIN = 1.5
"""Rates whose ratio lies between 1/1.5 and 1.5 count as equal."""
FLIPS = 20_000
"""Sign flips drawn where there are too many to try all."""
MOST_SEEDS = 10_000


@dataclass(frozen=True)
class Paired:
    """The ratio of two rates over the same seeds."""

    ratio: float
    low: float
    high: float
    """The two-sided 95 % interval of the ratio."""
    bound: float
    """The upper end of the one-sided 95 % interval."""
    p: float
    """The p value of the sign-flip permutation test, two-sided."""
    seeds: int
    needed: int
    """Seeds with which the interval would be narrow enough to decide, at this mean and spread."""

    @property
    def verdict(self) -> Verdict:
        """Better: surely fewer bumps. Equal: surely within the margin."""
        if self.low > 1.0 / MARGIN and self.high < MARGIN:
            return "equal"
        if self.high < 1.0:
            return "better"
        return "worse" if self.low > 1.0 else "undecided"

    @property
    def not_inferior(self) -> bool:
        """Whether it surely bumps less than 1.5 times as often."""
        return self.bound < MARGIN


def log_rates(bumps: Floats, actions: Floats) -> Floats:
    """log((bumps + 0.5) / actions): float64 [n]."""
    return np.log((bumps + 0.5) / actions)


def paired(ours: Floats, theirs: Floats) -> Paired:
    """Compare logs of rates by seed: float64 [n] each. Raises ValueError unless n is 2 or more."""
    if len(ours) != len(theirs) or len(ours) < 2:
        raise ValueError(f"expected as many seeds, at least 2, got {len(ours)} and {len(theirs)}")
    differences = ours - theirs
    mean, n = float(differences.mean()), len(differences)
    error = float(differences.std(ddof=1)) / math.sqrt(n)
    half = float(stats.t.ppf((1.0 + LEVEL) / 2.0, n - 1)) * error
    return Paired(
        ratio=math.exp(mean),
        low=math.exp(mean - half),
        high=math.exp(mean + half),
        bound=math.exp(mean + float(stats.t.ppf(LEVEL, n - 1)) * error),
        p=_flipped(differences),
        seeds=n,
        needed=_needed(mean, error * math.sqrt(n)),
    )


def holm(p: Mapping[str, float]) -> dict[str, float]:
    """Correct p values for their number by Holm's method; names stay."""
    corrected, highest = {}, 0.0
    for rank, name in enumerate(sorted(p, key=lambda each: p[each])):
        highest = max(highest, min(1.0, (len(p) - rank) * p[name]))
        corrected[name] = highest
    return {name: corrected[name] for name in p}


def max_t(differences: Mapping[str, Floats]) -> dict[str, float]:
    """Return p values of several comparisons over the same seeds, corrected by max-T.

    Signs are flipped for all comparisons alike, so that what they have in common counts
    (Westfall and Young).

    Args:
        differences: By comparison, the differences of the logs: float64 [n], equally many.
    """
    together = np.stack(list(differences.values()))
    observed = np.abs(_t(together))
    signs = _signs(together.shape[1])
    largest = np.array([np.abs(_t(together * each)).max() for each in signs])
    p = [(largest >= value - 1e-12).mean() for value in observed]
    return {name: float(value) for name, value in zip(differences, p, strict=True)}


def interquartile_mean(values: Floats) -> float:
    """Return the mean of the middle half."""
    return float(stats.trim_mean(values, 0.25))


def _flipped(differences: Floats) -> float:
    """The p value of the sign-flip test: all flips with up to 14 seeds."""
    flipped = _signs(len(differences)) @ differences
    return float((np.abs(flipped) >= abs(differences.sum()) - 1e-12).mean())


def _signs(seeds: int) -> Floats:
    """All rows of signs, or `FLIPS` of them by chance where there are more; ones are the first."""
    if 2**seeds <= FLIPS:
        bits = (np.arange(2**seeds)[:, None] >> np.arange(seeds)) & 1
        return np.asarray(1.0 - 2.0 * bits)
    drawn = generator(0, "sign flips", seeds).choice([-1.0, 1.0], (FLIPS, seeds))
    drawn[0] = 1.0
    return np.asarray(drawn)


def _t(differences: Floats) -> Floats:
    """Return the t value of each row: float64 [rows]. Of zeros it is 0."""
    error = differences.std(axis=1, ddof=1) / math.sqrt(differences.shape[1])
    return np.asarray(differences.mean(axis=1) / np.maximum(error, 1e-300))


def _needed(mean: float, deviation: float) -> int:
    """The fewest seeds, to a twentieth, with which the interval of the mean would decide."""
    distances = [abs(mean)]  # from 1: better or worse
    if abs(mean) < math.log(MARGIN):
        distances.append(math.log(MARGIN) - abs(mean))  # from the margin: equal
    seeds = np.unique(np.geomspace(2, MOST_SEEDS, 175).round().astype(np.int64))
    half = stats.t.ppf((1.0 + LEVEL) / 2.0, seeds - 1) * deviation / np.sqrt(seeds)
    decides = seeds[half < max(distances)]
    return int(decides[0]) if len(decides) else MOST_SEEDS
