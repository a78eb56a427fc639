"""Novelty: the mirror of RMM. What looks like an older sample goes, not what looks like a newer."""

from __future__ import annotations

from typing import Literal

from shared.rl.retention.rmm import RMM
from shared.rl.similarity import Descriptors, Mask, similar_to_newer


class Novelty(RMM):
    """Of two similar samples of one action the newer is the candidate.

    Quotas, thresholds, counts and the order in which candidates go, oldest first, are those of RMM.
    """

    def similar(self, descriptors: Descriptors, bits: int, rule: Literal["paper", "cover"]) -> Mask:
        """Mark samples of one action that look like an older one: bool [n]."""
        return similar_to_newer(descriptors[::-1], bits, rule)[::-1]


STRATEGY = Novelty()
