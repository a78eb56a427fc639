"""Coverage: what stays covers the space of descriptors, whatever the actions."""

from __future__ import annotations

from shared.rl.retention.columns import DESCRIBED, renew_descriptors
from shared.rl.retention.most_alike import Distances, MostAlike, hamming
from shared.rl.retention.strategy import Situation


class Coverage(MostAlike):
    """Two samples are alike if few bits of their descriptors differ."""

    columns = DESCRIBED

    def renew(self, there: Situation) -> bool:
        """Describe what the weights in force have not described."""
        return renew_descriptors(there)

    def distances(self, there: Situation) -> Distances:
        """Return what counts the bits that differ."""
        return hamming(there.memory.rows["descriptor"])


STRATEGY = Coverage()
