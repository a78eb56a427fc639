"""Computes where a body velocity leads on a floor without walls."""

from __future__ import annotations

import math

from services.robot_driver.robot import Pose, Velocity


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
