"""Quotas: of each action above its share of the memory, the oldest samples go (A33 alone)."""

from __future__ import annotations

import numpy as np

from shared.rl.retention.amounts import surplus_by_action
from shared.rl.retention.strategy import Discard, Floats, Situation, Strategy, lowest


class Quotas(Strategy):
    """Only actions above N / 3 lose samples, down to 99 % of N / 3."""

    def choose(self, there: Situation) -> Discard:
        """Choose, of each such action, the samples of least worth."""
        memory, worth = there.memory, self.worth(there)
        gone = np.zeros(len(memory), np.bool_)
        for action, count in surplus_by_action(memory, memory.capacity).items():
            own = np.flatnonzero(memory.rows["action"] == action)
            gone[own[lowest(worth[own], count)]] = True
        return Discard(memory.capacity, memory.ids[gone])

    def worth(self, there: Situation) -> Floats:
        """Return what each sample is worth: the newer, the more. float64 [n]."""
        return np.arange(len(there.memory), dtype=np.float64)


STRATEGY = Quotas()
