"""A steady frame for odometry that a robot may reset or that may jump (no clock)."""

from __future__ import annotations

import math

from services.robot_driver.robot import Pose

SPEED_M_S, TURN_RAD_S = 3.0, 6.0
"""Faster than any robot here moves."""
SLACK_M, SLACK_RAD = 0.2, 0.5


class OdometryFrame:
    """Poses as seen from the first one; a jump of the robot's own counting leaves no trace."""

    def __init__(self) -> None:
        self.jumps = 0
        self._raw: tuple[Pose, float] | None = None
        self._pose = Pose(0.0, 0.0, 0.0)

    def pose(self, raw: Pose, stamp_s: float) -> Pose:
        """The pose of a newer reading of odometry, taken at `stamp_s`."""
        if self._raw is not None and raw != self._raw[0]:
            before, then_s = self._raw
            step = between(before, raw)
            if self._possible(step, stamp_s - then_s):
                self._pose = joined(self._pose, step)
            else:
                self.jumps += 1
        self._raw = (raw, stamp_s)
        return self._pose

    def _possible(self, step: Pose, duration_s: float) -> bool:
        way = math.hypot(step.x_m, step.y_m)
        return (
            way <= SPEED_M_S * duration_s + SLACK_M
            and abs(step.heading_rad) <= TURN_RAD_S * duration_s + SLACK_RAD
        )


def between(start: Pose, end: Pose) -> Pose:
    """Where `end` is, seen from `start`."""
    dx, dy = end.x_m - start.x_m, end.y_m - start.y_m
    c, s = math.cos(start.heading_rad), math.sin(start.heading_rad)
    turn = math.remainder(end.heading_rad - start.heading_rad, 2.0 * math.pi)
    return Pose(c * dx + s * dy, c * dy - s * dx, turn)


def joined(start: Pose, step: Pose) -> Pose:
    """Where a step, seen from `start`, leads."""
    c, s = math.cos(start.heading_rad), math.sin(start.heading_rad)
    return Pose(
        start.x_m + c * step.x_m - s * step.y_m,
        start.y_m + s * step.x_m + c * step.y_m,
        math.remainder(start.heading_rad + step.heading_rad, 2.0 * math.pi),
    )
