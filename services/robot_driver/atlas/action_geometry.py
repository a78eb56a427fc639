"""Computes exactly where the three actions lead on a map, and how near to walls (A21)."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from services.robot_driver.simulated.world import World
from shared.config import RobotConfig
from shared.facts import ACTIONS

Floats = npt.NDArray[np.float64]

TURNS = tuple(float(action.turn) for action in ACTIONS)
"""Turn of every action in units of the turn rate."""
CONTACT_M = 0.001
"""Gap to a wall that counts as contact, as in the simulation."""
_EXACT_STEP_M = 0.01
"""Distance of the points at which the gap to walls is looked at."""


@dataclass(frozen=True)
class ActionGeometry:
    """Lengths and angles of the actions, and the radius of the round shell."""

    step_m: float
    """Forward way of one action."""
    turn_rad: float
    """Turn of one turning action."""
    radius_m: float

    @classmethod
    def of(cls, config: RobotConfig) -> "ActionGeometry":
        """The actions of a configured robot."""
        period = config.period_s
        return cls(config.speed_m_s * period, config.turn_rad_s * period, config.radius_m)

    @property
    def turning_radius_m(self) -> float:
        """Radius of the arc that a turning action drives."""
        return self.step_m / self.turn_rad

    def move(self, poses: Floats, action: int, part: float = 1.0) -> Floats:
        """Where part of an action leads: float64 [n, 3] of x, y, heading to the same."""
        half = TURNS[action] * self.turn_rad * part / 2.0
        chord = self.step_m * part * (math.sin(half) / half if half else 1.0)
        heading = poses[:, 2] + half
        x = poses[:, 0] + chord * np.cos(heading)
        y = poses[:, 1] + chord * np.sin(heading)
        return np.column_stack([x, y, heading + half])

    def gap(self, world: World, poses: Floats, action: int) -> Floats:
        """Least gap to a wall on the way of one action, looked at every centimetre; float64 [n]."""
        steps = math.ceil(self.step_m / _EXACT_STEP_M - 1e-9)
        way = [self.move(poses, action, (i + 1) / steps)[:, :2] for i in range(steps)]
        gaps = world.clearance(np.vstack(way)).reshape(steps, len(poses))
        return np.asarray(gaps.min(axis=0)) - self.radius_m
