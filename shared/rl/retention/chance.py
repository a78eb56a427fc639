"""Random: at each discard, chance decides anew among all that are stored."""

from __future__ import annotations

from dataclasses import replace

from shared.rl.draws import uniform
from shared.rl.retention.least_worth import LeastWorth
from shared.rl.retention.strategy import Discard, Floats, Situation


class Random(LeastWorth):
    """Each stored sample goes with the same probability, until floor(0.99 N) remain.

    So the past fades: what has seen k N samples come after it is left with probability e^-k.
    """

    def worth(self, there: Situation) -> Floats:
        """Return a draw for each sample, another one at each discard: float64 [n]."""
        role = f"retention, draw {self._draws(there)}"
        return uniform(there.seed, role, there.memory.ids)

    def choose(self, there: Situation) -> Discard:
        """Choose by chance, and count the discard."""
        return replace(super().choose(there), keep={"random_draws": self._draws(there) + 1})

    @staticmethod
    def _draws(there: Situation) -> int:
        return there.memory.kept.get("random_draws", 0)


STRATEGY = Random()
