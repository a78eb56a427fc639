"""The base of strategies that give each sample a worth: those of least worth go."""

from __future__ import annotations

from abc import abstractmethod

from shared.rl.retention.amounts import surplus
from shared.rl.retention.strategy import Discard, Floats, Situation, Strategy, lowest


class LeastWorth(Strategy):
    """The samples of least worth go, of equal ones the older, until floor(0.99 N) remain."""

    def renew(self, there: Situation) -> bool:
        """Bring its own columns up to date; return whether any changed."""
        del there
        return False

    @abstractmethod
    def worth(self, there: Situation) -> Floats:
        """Return what each sample is worth: float64 [n]. The columns are up to date."""

    def choose(self, there: Situation) -> Discard:
        """Choose the samples of least worth."""
        memory, changed = there.memory, self.renew(there)
        gone = lowest(self.worth(there), surplus(memory))
        return Discard(memory.capacity, memory.ids[gone], marked=changed)
