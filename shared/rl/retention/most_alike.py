"""The base of strategies that thin out: the older of the two most alike samples goes, repeatedly.

All that stays then keeps its distance from all else, as far as that is possible.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from shared.rl.retention.amounts import surplus
from shared.rl.retention.columns import DESCRIBED, renew_descriptors
from shared.rl.retention.strategy import Discard, Situation, Strategy
from shared.rl.similarity import Descriptors

Ranks = npt.NDArray[np.int64]
Distances = Callable[[Ranks, int], npt.NDArray[Any]]
"""(ranks of k samples, start) -> their distances from all samples of rank `start` on, as floats
[k, n - start] of at most `FAR`. The array is overwritten."""
FAR = np.float32(1e30)
"""The distance of samples that must not be compared."""
ROWS = 512
"""Samples compared with all newer ones at a time."""


class MostAlike(Strategy):
    """Again and again the older of the two most alike samples goes, until floor(0.99 N) remain.

    Of pairs that are equally alike the one goes whose older sample is the oldest.
    """

    def renew(self, there: Situation) -> bool:
        """Bring its own columns up to date; return whether any changed."""
        del there
        return False

    @abstractmethod
    def distances(self, there: Situation) -> Distances:
        """Return what computes distances. The columns are up to date."""

    def choose(self, there: Situation) -> Discard:
        """Choose the older ones of the most alike."""
        memory, changed = there.memory, self.renew(there)
        gone = older_of_most_alike(self.distances(there), len(memory), surplus(memory))
        return Discard(memory.capacity, memory.ids[gone], marked=changed)


class Coverage(MostAlike):
    """What stays covers the space of descriptors: two samples are alike if few bits differ."""

    columns = DESCRIBED

    def renew(self, there: Situation) -> bool:
        """Describe what the weights in force have not described."""
        return renew_descriptors(there)

    def distances(self, there: Situation) -> Distances:
        """Return what counts the bits that differ."""
        return hamming(there.memory.rows["descriptor"])


def older_of_most_alike(distances: Distances, n: int, count: int) -> Ranks:
    """Return the ranks of the `count` of n samples that go, ascending.

    The sample that goes is always that with the least distance from a newer one. So each keeps its
    nearest newer sample, and looks for another one only when that goes.
    """
    gone = np.zeros(n, np.bool_)
    least, nearest = np.empty(n), np.empty(n, np.int64)
    for start in range(0, n, ROWS):
        block = np.arange(start, min(start + ROWS, n))
        least[block], nearest[block] = _nearest_newer(distances, block, gone)
    for _ in range(count):
        first = int(np.argmin(least))
        gone[first], least[first], nearest[first] = True, np.inf, -1
        bereft = np.flatnonzero(nearest == first)
        if len(bereft):
            least[bereft], nearest[bereft] = _nearest_newer(distances, bereft, gone)
    return np.flatnonzero(gone)


def hamming(packed: Descriptors) -> Distances:
    """Return what counts the bits in which packed rows uint8 [n, bytes] differ."""
    bits = 8 * packed.shape[1]
    signs = torch.from_numpy(np.unpackbits(packed, axis=1).astype(np.float32) * 2.0 - 1.0)

    def distances(ranks: Ranks, start: int) -> npt.NDArray[Any]:
        products = signs[torch.from_numpy(ranks)] @ signs[start:].T  # whole numbers: exact
        return products.sub_(bits).mul_(-0.5).numpy()

    return distances


def _nearest_newer(
    distances: Distances, ranks: Ranks, gone: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[Any], Ranks]:
    """The least distance of each from a newer sample that has not gone, and the rank of that one.

    ranks: ascending. Of equally near ones the newest is taken: the older would go first.
    """
    start, end = int(ranks[0]), int(ranks[-1]) + 1
    found = distances(ranks, start)
    found[:, : end - start][np.arange(start, end) <= ranks[:, np.newaxis]] = FAR
    found[:, gone[start:]] = FAR
    nearest = found.shape[1] - 1 - np.argmin(found[:, ::-1], axis=1)
    return found[np.arange(len(ranks)), nearest], start + nearest


COVERAGE = Coverage()
