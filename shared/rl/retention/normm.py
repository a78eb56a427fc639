"""NoRMM: the oldest samples go, whatever they show (A28)."""

from __future__ import annotations

from shared.rl.retention.amounts import surplus
from shared.rl.retention.strategy import Discard, Situation, Strategy


class NoRMM(Strategy):
    """Oldest first, until floor(0.99 N) samples remain."""

    def choose(self, there: Situation) -> Discard:
        """Choose the oldest samples."""
        memory = there.memory
        return Discard(memory.capacity, memory.ids[: surplus(memory)].copy())


STRATEGY = NoRMM()
