"""Worlds: an equal part of the memory for each world, and a reservoir in each part.

Strategies are not told in which world a sample arose; this one is.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from shared.rl.retention.amounts import kept_in_total
from shared.rl.retention.strategy import Discard, Situation, Strategy, chances, lowest


class Worlds(Strategy):
    """In each world above its quota the samples go whose chances are lowest.

    The quotas add up to floor(0.99 N). A world with fewer samples leaves the rest to the others.
    """

    def choose(self, there: Situation) -> Discard:
        """Choose, in each world, the samples with the lowest chances."""
        memory, worth = there.memory, chances(there.seed, there.memory.ids)
        worlds = memory.rows["world"].copy()
        counts = np.bincount(worlds)
        gone = np.zeros(len(memory), np.bool_)
        for world, kept in enumerate(equal_quotas(counts, kept_in_total(memory.capacity))):
            own = np.flatnonzero(worlds == world)
            gone[own[lowest(worth[own], counts[world] - kept)]] = True
        return Discard(memory.capacity, memory.ids[gone])


def equal_quotas(counts: npt.NDArray[np.int64], total: int) -> list[int]:
    """Return how many of each world stay, `total` together: as equal as their counts allow.

    counts: samples of each world, at least `total` together. What does not divide goes to the
    larger worlds, of equal ones to the later.
    """
    kept, left = [0] * len(counts), total
    for place, world in enumerate(np.argsort(counts, kind="stable")):
        kept[world] = min(int(counts[world]), left // (len(counts) - place))
        left -= kept[world]
    return kept


STRATEGY = Worlds()
