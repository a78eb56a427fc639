"""Figures of curves and seeds: pure functions of arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Curve = tuple[Floats, Floats]
"""Ascending places and the values there, float64 [n] each."""


@dataclass(frozen=True)
class Band:
    """Seeds together: lowest, middle and highest value at every place."""

    x: Floats
    low: Floats
    median: Floats
    high: Floats
    seeds: int


def block_means(episodes: Floats, values: Floats, size: int) -> Curve:
    """Means of every `size` episodes, as the thesis draws its curves (A37).

    A block that is not full is left out, as is one without any value (NaN).

    Args:
        episodes: Ascending episode numbers, float64 [n].
        values: One per episode, NaN for none, float64 [n].
        size: Episodes of a block.

    Returns:
        Number of the last episode of each block, and its mean.
    """
    full = len(values) // size
    cut = values[: full * size].reshape(full, size)
    there = ~np.isnan(cut)
    count = there.sum(axis=1)
    some = count > 0
    sums = np.where(there, cut, 0.0).sum(axis=1)
    return episodes[size - 1 : full * size : size][some], sums[some] / count[some]


def band_of_blocks(curves: Sequence[Curve]) -> Band:
    """Seeds whose curves have values at the same places; a place counts where any seed has it."""
    x = np.unique(np.concatenate([places for places, _ in curves]))
    values = np.full((len(curves), len(x)), np.nan)
    for row, (places, heights) in zip(values, curves, strict=True):
        row[np.searchsorted(x, places)] = heights
    return _band(x, values)


def band_between(curves: Sequence[Curve]) -> Band:
    """Seeds whose curves have values at places of their own, straight lines between these.

    The band begins where all seeds have begun and ends where the first one ends.
    """
    start = max(float(places[0]) for places, _ in curves)
    end = min(float(places[-1]) for places, _ in curves)
    x = np.unique(np.concatenate([places for places, _ in curves]))
    x = x[(x >= start) & (x <= end)]
    values = np.array([np.interp(x, places, heights) for places, heights in curves])
    return _band(x, values)


def _band(x: Floats, values: Floats) -> Band:
    if not len(x):
        return Band(x, x, x, x, len(values))
    return Band(
        x,
        np.nanmin(values, axis=0),
        np.nanmedian(values, axis=0),
        np.nanmax(values, axis=0),
        len(values),
    )


def with_gaps(band: Band, longest: float) -> Band:
    """The same band, with NaN in the middle of every stretch longer than this without a value."""
    after = np.flatnonzero(np.diff(band.x) > longest) + 1
    middles = (band.x[after - 1] + band.x[after]) / 2.0
    low, median, high = (np.insert(y, after, np.nan) for y in (band.low, band.median, band.high))
    return Band(np.insert(band.x, after, middles), low, median, high, band.seeds)


def from_the_start(band: Band, first: float) -> Band:
    """The same band with places counted from 1 at `first`."""
    return Band(band.x - first + 1.0, band.low, band.median, band.high, band.seeds)
