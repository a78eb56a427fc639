"""Counts laps round the centre of a world by the angle that the robot has turned round it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from services.robot_driver.robot import Laps, Pose
from services.robot_driver.simulated.kinematics import wrap


@dataclass
class LapCounter:
    """A lap counts when 2 pi of new net angle round the centre is reached."""

    winding_rad: float = 0.0
    """Net angle so far, in this world."""
    lap_start_rad: float = 0.0
    """Net angle at which the newest lap was counted."""
    left: int = 0
    right: int = 0

    @property
    def laps(self) -> Laps:
        """Laps so far, in all worlds."""
        return Laps(self.left - self.right, self.left, self.right)

    def add(self, centre: tuple[float, float], before: Pose, after: Pose) -> None:
        """Count a small step from one pose to another."""
        cx, cy = centre
        now = math.atan2(after.y_m - cy, after.x_m - cx)
        self.winding_rad += wrap(now - math.atan2(before.y_m - cy, before.x_m - cx))
        progress = self.winding_rad - self.lap_start_rad
        if abs(progress) >= 2.0 * math.pi:
            self.lap_start_rad += math.copysign(2.0 * math.pi, progress)
            if progress > 0.0:
                self.left += 1
            else:
                self.right += 1
