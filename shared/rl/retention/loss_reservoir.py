"""Loss-aware reservoir: samples go by chance, the less their loss, the sooner.

After Buzzega et al., "Rethinking Experience Replay: a Bag of Tricks for Continual Learning" (2020).
"""

from __future__ import annotations

import numpy as np

from shared.rl.retention.columns import errors
from shared.rl.retention.strategy import Floats, Situation, chances
from shared.rl.retention.surprise import Surprise

LEAST_LOSS = 1e-3
"""Added to each loss, so that a sample predicted exactly is not the certain next to go."""


class LossReservoir(Surprise):
    """A reservoir whose samples weigh as much as their loss (r - Q(s, a))^2.

    Of chance u and weight w, u^(1/w) is the key of weighted drawing (Efraimidis and Spirakis):
    the sample with the lowest key goes. Keys follow the loss as the network learns.
    """

    def worth(self, there: Situation) -> Floats:
        """Return the logarithms of the keys, which are in the same order: float64 [n]."""
        drawn = np.maximum(chances(there.seed, there.memory.ids), np.finfo(np.float64).tiny)
        return np.log(drawn) / (errors(there) ** 2 + LEAST_LOSS)


STRATEGY = LossReservoir()
