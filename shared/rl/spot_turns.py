"""Turning on the spot where nothing good is predicted (A45, Fig 4.20, E33).

Where the reward predicted for its best action is negative, the robot turns on the spot, to the side
of that action, else to the right, until an action with a prediction of 0 or more comes up.
"""

import math
from typing import Literal

from shared.facts import ACTIONS
from shared.rl.policy import Values

MOST_TURNING_RAD = math.radians(720.0)
"""A robot that finds no way out after two full turns drives on regardless (E33)."""
Side = Literal["", "left", "right"]


class SpotTurns:
    """When to turn on the spot, and to which side; a turn by `turn_rad` is as long as an action."""

    def __init__(self, turn_rad: float) -> None:
        self._most = round(MOST_TURNING_RAD / turn_rad)
        self._side: Side = ""
        self._turns = 0

    def decide(self, values: Values, action: int) -> Side:
        """The side to turn to now, or empty: drive the action, the best by clipped predictions."""
        if values[action] >= 0.0 or self._turns >= self._most:
            self._side, self._turns = "", 0
            return ""
        if not self._side:
            self._side = "left" if ACTIONS[action].turn > 0 else "right"
        self._turns += 1
        return self._side
