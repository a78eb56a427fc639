"""RMM without quotas: the oldest candidates of all actions go."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from shared.rl.retention.amounts import kept_in_total
from shared.rl.retention.rmm import RMM, Part

if TYPE_CHECKING:
    from shared.rl.memory import ReplayMemory


class RMMTotal(RMM):
    """Candidates go whatever their action, oldest first, until floor(0.99 N) samples remain.

    Too few candidates are too few of all actions together.
    """

    def losing(self, memory: ReplayMemory, capacity: int) -> list[Part]:
        """Return the whole memory and how much of it must go; nothing if it fits."""
        if len(memory) <= capacity:
            return []
        return [Part(np.ones(len(memory), np.bool_), len(memory) - kept_in_total(capacity))]


STRATEGY = RMMTotal()
