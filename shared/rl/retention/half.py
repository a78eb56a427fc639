"""Half: half of what stays is the newest, the other half a reservoir of everything older."""

from __future__ import annotations

from shared.rl.retention.amounts import kept_in_total
from shared.rl.retention.least_worth import LeastWorth
from shared.rl.retention.strategy import Floats, Situation, chances


class Half(LeastWorth):
    """The newest floor(0.99 N) / 2 stay, and of the older ones those whose chances are highest.

    Among the newest nothing is chosen, so the rest is a fair draw from all that is older.
    """

    def worth(self, there: Situation) -> Floats:
        """Return the chances of all samples, and more for the newest: float64 [n]."""
        worth = chances(there.seed, there.memory.ids)
        worth[-(kept_in_total(there.memory.capacity) // 2) :] = 1.0  # every chance is below 1
        return worth


STRATEGY = Half()
