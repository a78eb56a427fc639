"""NoRMM: the oldest samples go, whatever they show (A28)."""

from __future__ import annotations

from shared.rl.retention.strategy import Discard, Situation, Strategy


def normm_keep(capacity: int) -> int:
    """Return the samples kept in total: floor(0.99 N) (A27, E22)."""
    return 99 * capacity // 100


class NoRMM(Strategy):
    """Oldest first, until floor(0.99 N) samples remain."""

    def choose(self, there: Situation) -> Discard:
        """Choose the oldest samples."""
        memory = there.memory
        surplus = len(memory) - normm_keep(memory.capacity)
        return Discard(memory.capacity, memory.ids[:surplus].copy())


STRATEGY = NoRMM()
