"""Curves of seeds, and seeds together: pure functions of arrays."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Curve = tuple[Floats, Floats]
"""Ascending places and the values there, float64 [n] each."""


class Band(NamedTuple):
    """Seeds together at ascending places."""

    x: Floats
    levels: Floats
    """float64 [3, n]: lowest, middle and highest value at every place; NaN is a gap."""
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
    some = ~np.isnan(cut).all(axis=1)
    return episodes[size - 1 : full * size : size][some], np.nanmean(cut[some], axis=1)


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
    return _band(x, np.array([np.interp(x, places, heights) for places, heights in curves]))


def _band(x: Floats, values: Floats) -> Band:
    levels = (np.nanmin(values, axis=0), np.nanmedian(values, axis=0), np.nanmax(values, axis=0))
    return Band(x, np.stack(levels), len(values))


def with_gaps(band: Band, longest: float) -> Band:
    """The same band, with NaN in the middle of every stretch longer than this without a value."""
    after = np.flatnonzero(np.diff(band.x) > longest) + 1
    middles = (band.x[after - 1] + band.x[after]) / 2.0
    levels = np.insert(band.levels, after, np.nan, axis=1)
    return Band(np.insert(band.x, after, middles), levels, band.seeds)
