"""Quotas with a reservoir in each: of each action above its share, samples go by chance."""

from __future__ import annotations

from shared.rl.retention.quotas import Quotas
from shared.rl.retention.strategy import Floats, Situation, chances


class QuotasReservoir(Quotas):
    """Only actions above N / 3 lose samples, those whose chances are lowest."""

    def worth(self, there: Situation) -> Floats:
        """Return the chances of all samples: float64 [n]."""
        return chances(there.seed, there.memory.ids)


STRATEGY = QuotasReservoir()
