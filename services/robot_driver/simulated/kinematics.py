"""Where a body velocity leads on a floor without walls, and the laps round a centre."""

import math
from dataclasses import dataclass

from services.robot_driver.robot import Laps, Pose, Velocity


def wrap(angle_rad: float) -> float:
    """The same direction in -pi..pi."""
    return math.remainder(angle_rad, 2.0 * math.pi)


def advance(pose: Pose, velocity: Velocity, duration_s: float) -> Pose:
    """The pose after constant body velocity: exact, an arc when turning."""
    turn = velocity.turn_rad_s * duration_s
    forward, left = velocity.forward_m_s * duration_s, velocity.left_m_s * duration_s
    half = turn / 2.0
    chord = math.sin(half) / half if abs(half) > 1e-9 else 1.0
    c, s = math.cos(pose.heading_rad + half), math.sin(pose.heading_rad + half)
    return Pose(
        pose.x_m + chord * (forward * c - left * s),
        pose.y_m + chord * (forward * s + left * c),
        wrap(pose.heading_rad + turn),
    )


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
