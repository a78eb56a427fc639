"""What a robot does after a bump (E11): retreat by real motion, then turn on the spot.

The bumper has one bit for the whole ring: a pressed bumper cannot tell front from rear.
"""

import math

from services.robot_driver.host import Host
from services.robot_driver.robot import STANDSTILL, Base, Felt, Pose, Robot, Velocity
from services.robot_driver.safety import Safety
from shared.config import RobotConfig


class Halted(Exception):
    """An operator or the end of the service stopped the robot while it recovered."""


class WatchedRobot(Base):
    """A robot during recovery: every command passes the limits, and an operator can stop it.

    `host.look` is called every `slice_s` while the robot moves; a motion ends by the robot's clock,
    however long the looks take. With None it is one piece, as simulated time demands.
    """

    def __init__(self, robot: Robot, safety: Safety, host: Host, slice_s: float | None) -> None:
        self._robot, self._safety, self._host, self._slice_s = robot, safety, host, slice_s

    def feel(self) -> Felt:
        """Read odometry and bumper."""
        return self._robot.feel()

    def drive(self, velocity: Velocity) -> None:
        """Drive what the limits leave of this velocity."""
        self._robot.drive(self._safety.allow(velocity, self._robot.now_s()))

    def run(self, duration_s: float, *, stop_on_contact: bool) -> bool:
        """Let time pass, looking out for an operator. Raises Halted, standing still."""
        if duration_s <= 0.0:
            return False
        if self._slice_s is None:
            contact = self._robot.run(duration_s, stop_on_contact=stop_on_contact)
            self._look(stopping=False)
            return contact
        contact, end_s = False, self._robot.now_s() + duration_s
        while (left_s := end_s - self._robot.now_s()) > 1e-9:
            part_s = min(self._slice_s, left_s)
            contact |= self._robot.run(part_s, stop_on_contact=stop_on_contact)
            self._look(stopping=self._host.stopping)
        return contact

    def _look(self, *, stopping: bool) -> None:
        self._host.look()
        if self._safety.halted or stopping:
            self._robot.drive(STANDSTILL)
            raise Halted


RELEASE_M = 0.05
"""Way driven regardless of the bumper, to let go of the wall that pressed it."""
LET_GO_M = 0.15
"""Farthest way back out of the contact that a motion by hand ended in."""


def back_off(robot: Base, config: RobotConfig, heading_rad: float) -> float:
    """Retreat at most `recovery_distance_m`, then turn on the spot to `heading_rad` (odometry).

    A wall behind ends the retreat; the robot then creeps forward half the way it had won, unless
    the bumper never let go. Returns the metres between the poses before and after. Raises
    RobotFault.
    """
    start = robot.feel().pose
    blocked = _move(robot, config, -config.recovery_distance_m)
    here = robot.feel().pose
    if blocked:
        won_m = min(_distance(start, here), config.recovery_distance_m)  # odometry may jump
        _move(robot, config, won_m / 2.0)
        here = robot.feel().pose
    turn = math.remainder(heading_rad - here.heading_rad, 2.0 * math.pi)
    robot.drive(Velocity(0.0, 0.0, math.copysign(config.turn_rad_s, turn)))
    robot.run(abs(turn) / config.turn_rad_s, stop_on_contact=False)
    robot.drive(STANDSTILL)
    return _distance(start, here)


def let_go(robot: Base, config: RobotConfig, direction: float) -> None:
    """Creep straight until the bumper is free, at most `LET_GO_M`; stand still then.

    direction: 1.0 forward, -1.0 backwards. Raises RobotFault.
    """
    speed, left = _creeping(config), LET_GO_M
    while left > 0.0 and robot.feel().contact:
        part = min(left, RELEASE_M)
        robot.drive(Velocity(direction * speed, 0.0, 0.0))
        robot.run(part / speed, stop_on_contact=False)
        robot.drive(STANDSTILL)
        left -= part


def _creeping(config: RobotConfig) -> float:
    return min(config.recovery_speed_m_s, config.max_speed_m_s)


def _move(robot: Base, config: RobotConfig, distance_m: float) -> bool:
    """Drive straight, backwards if negative; return whether a wall on that side ended it."""
    left = abs(distance_m)
    speed = _creeping(config)
    pressed = robot.feel().contact
    while left > 0.0:
        part = min(left, RELEASE_M) if pressed else left
        robot.drive(Velocity(math.copysign(speed, distance_m), 0.0, 0.0))
        bumped = robot.run(part / speed, stop_on_contact=not pressed)
        robot.drive(STANDSTILL)
        if bumped and not pressed:
            return True
        left -= part
        pressed = pressed and robot.feel().contact
    return False


def _distance(a: Pose, b: Pose) -> float:
    return math.hypot(b.x_m - a.x_m, b.y_m - a.y_m)
