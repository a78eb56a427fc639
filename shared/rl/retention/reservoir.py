"""Reservoir: of everything that ever came, each sample stays with the same probability."""

from __future__ import annotations

from shared.rl.retention.least_worth import LeastWorth
from shared.rl.retention.strategy import Floats, Situation, chances


class Reservoir(LeastWorth):
    """The samples stay whose chances are highest, until floor(0.99 N) remain.

    A sample draws its chance once, from its insertion number. So what stays is a fair draw from all
    samples so far, however often the memory was reduced (Vitter, algorithm R, with a fixed key).
    """

    def worth(self, there: Situation) -> Floats:
        """Return the chances of all samples: float64 [n]."""
        return chances(there.seed, there.memory.ids)


STRATEGY = Reservoir()
