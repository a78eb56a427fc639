"""What odometry tells: poses that do not jump, and whether a robot moves as told (no clock)."""

import math
from collections import deque

from services.robot_driver.robot import Pose, Velocity

SPEED_M_S, TURN_RAD_S = 3.0, 6.0
"""Faster than any robot here moves."""
SLACK_M, SLACK_RAD = 0.2, 0.5
STILL_M, STILL_RAD = 0.003, 0.01
"""A robot that moved less has not moved."""
WINDOW_S, FREE_M, FREE_RAD, EXCESS = 1.0, 0.05, 0.15, 1.5
"""Within this time a robot may move so much that nobody ordered, by slip and noise, and farther
than ordered by this factor."""
LATE_S = 0.5
"""Longest that an order needs until it shows in the odometry, beside the time to rest."""
LEASE_S = 0.2
"""Longest that a base follows one command that is not repeated; below, a robot's watchdog."""
TRIES, PAUSE_S = 3, 2.0
"""A robot that does not follow is told again so often, after pauses that double; then it waits
until its odometry shows that somebody moved it."""


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


class MotionWatch:
    """Compares what a robot was told with its odometry. rest_s: to come to rest or to move."""

    def __init__(self, rest_s: float) -> None:
        self._rest_s = rest_s
        self._told_s = 0.0
        """Time of driving that was ordered since the odometry last moved."""
        self._ordered: deque[tuple[float, float, float]] = deque([(-math.inf, 0.0, 0.0)])
        """When, and the way and the turn that were ordered until then."""
        self._seen: deque[tuple[float, Pose]] = deque()
        self._since: Pose | None = None
        self._tries = 0
        self._until_s = -math.inf
        self.pushed = False
        """It moves though nobody ordered it."""

    def told(self, velocity: Velocity, now_s: float, *, pressed: bool) -> None:
        """This velocity was in force since the last call. A pressed robot may be held by a wall."""
        then_s, way_m, turn_rad = self._ordered[-1]
        passed_s = min(now_s - then_s, LEASE_S)
        if velocity.moving and not pressed:
            self._told_s += passed_s
        way_m += math.hypot(velocity.forward_m_s, velocity.left_m_s) * passed_s
        self._ordered.append((now_s, way_m, turn_rad + abs(velocity.turn_rad_s) * passed_s))
        while self._ordered[1][0] < now_s - WINDOW_S - LATE_S - self._rest_s:
            self._ordered.popleft()

    def moved(self, pose: Pose, stamp_s: float, now_s: float) -> None:
        """A new pose, as of `stamp_s`."""
        self._seen.append((stamp_s, pose))
        while self._seen[0][0] < stamp_s - WINDOW_S:
            self._seen.popleft()
        way_m, turn_rad = _way(self._seen[0][1], pose)
        ordered_m = EXCESS * (self._ordered[-1][1] - self._ordered[0][1])
        ordered_rad = EXCESS * (self._ordered[-1][2] - self._ordered[0][2])
        self.pushed = way_m > ordered_m + FREE_M or turn_rad > ordered_rad + FREE_RAD
        way_m, turn_rad = _way(self._since or pose, pose)
        if self._since is None or way_m > STILL_M or turn_rad > STILL_RAD:
            self._since, self._told_s, self._tries = pose, 0.0, 0
        elif self._told_s - (now_s - stamp_s) > self._rest_s:
            self._until_s = now_s + PAUSE_S * 2.0**self._tries
            self._told_s, self._tries = 0.0, self._tries + 1

    def problem(self, now_s: float) -> str:
        """Why the robot must not move now; empty when it may."""
        if self.pushed:
            return "odometry: the robot moves though nobody told it to"
        if self._tries > TRIES:
            return "odometry: stands though the robot is told to drive: push it a little to go on"
        if self._tries and now_s < self._until_s:
            return "odometry: stands though the robot is told to drive"
        return ""


def _way(start: Pose, end: Pose) -> tuple[float, float]:
    step = between(start, end)
    return math.hypot(step.x_m, step.y_m), abs(step.heading_rad)
