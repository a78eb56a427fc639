"""Surprise: what stays is what the network in force predicts worst."""

from __future__ import annotations

import numpy as np

from shared.rl.retention.columns import PREDICTED, errors, renew_predictions
from shared.rl.retention.least_worth import LeastWorth
from shared.rl.retention.strategy import Floats, Situation


class Surprise(LeastWorth):
    """The samples with the least |r - Q(s, a)| go, until floor(0.99 N) remain.

    The prediction is kept with each sample, not the error: rewards change as they are equalised.
    """

    columns = PREDICTED

    def renew(self, there: Situation) -> bool:
        """Predict what the weights in force have not predicted."""
        return renew_predictions(there)

    def worth(self, there: Situation) -> Floats:
        """Return |r - Q(s, a)|: float64 [n]."""
        return np.abs(errors(there))


STRATEGY = Surprise()
