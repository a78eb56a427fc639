"""Reservoir: of everything that ever came, each sample stays with the same probability."""

from __future__ import annotations

from shared.rl.retention.amounts import surplus
from shared.rl.retention.strategy import Discard, Situation, Strategy, chances, lowest


class Reservoir(Strategy):
    """The samples stay whose chances are highest, until floor(0.99 N) remain.

    A sample draws its chance once, from its insertion number. So what stays is a fair draw from all
    samples so far, however often the memory was reduced (Vitter, algorithm R, with a fixed key).
    """

    def choose(self, there: Situation) -> Discard:
        """Choose the samples with the lowest chances."""
        memory = there.memory
        gone = lowest(chances(there.seed, memory.ids), surplus(memory))
        return Discard(memory.capacity, memory.ids[gone])


STRATEGY = Reservoir()
