"""`corridor robot calibrate`: what a real robot makes of its commands, measured by driving it."""

import math
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from services.robot_driver.motion_control import action_velocity
from services.robot_driver.real.hardware import HardwareRobot
from services.robot_driver.real.link import Link
from services.robot_driver.robot import STANDSTILL, NotReady, Pose, Robot, RobotFault, Velocity
from services.robot_driver.setup.response import Response, response
from shared.config import CalibrationConfig, Config
from shared.errors import ConfigError, RobotMissing
from shared.facts import ACTIONS

SLICE_S = 0.02
"""How often the odometry is looked at."""
REST_S = 1.5
"""The robot comes to rest between two drives."""
LONGEST_S, TURN_S = 4.0, 2.5
READY_S = 20.0
"""Longest that the robot may take until its sensors tell something."""
AGREE = 0.1
"""Two ways of measuring the same may differ by this part."""
Echo = Callable[[str], None]


@dataclass
class Tape:
    """Poses of a drive, and when they were counted, since the command."""

    times_s: list[float]
    poses: list[Pose]

    def way(self, velocity: Velocity) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        """Metres along the heading at the start, or radians, in the direction of the command."""
        start = self.poses[0]
        if velocity.forward_m_s:
            along = [
                (pose.x_m - start.x_m) * math.cos(start.heading_rad)
                + (pose.y_m - start.y_m) * math.sin(start.heading_rad)
                for pose in self.poses
            ]
            return np.array(along) * math.copysign(1.0, velocity.forward_m_s)
        return self.turn() * math.copysign(1.0, velocity.turn_rad_s)

    def turn(self) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        """Radians turned since the start, left is positive."""
        return np.unwrap([pose.heading_rad for pose in self.poses]) - self.poses[0].heading_rad


def calibrate(
    config: Config, robot: Robot, link: Link, space_m: float, made: str, echo: Echo
) -> CalibrationConfig:
    """Drive ahead and back, turn both ways, and compare with the actions that turn.

    robot: ready to drive, with `space_m` free ahead of it and room to turn. made: provenance.
    Raises RobotMissing if it cannot drive, ConfigError if it touched something, did not follow, or
    two measurements disagree.
    """
    driver = _Drives(config, robot, link, echo)
    speed, turn = config.robot.speed_m_s, config.robot.turn_rad_s
    straight_s = min(space_m / speed, LONGEST_S)
    ahead = driver.measure("ahead", Velocity(speed, 0.0, 0.0), straight_s)
    back = driver.measure("back", Velocity(-speed, 0.0, 0.0), straight_s)
    left = driver.measure("turn left", Velocity(0.0, 0.0, turn), TURN_S)
    right = driver.measure("turn right", Velocity(0.0, 0.0, -turn), TURN_S)
    _agree("speed ahead and back", ahead.speed, back.speed)
    _agree("turn rate to the left and to the right", left.speed, right.speed)
    found = CalibrationConfig(
        speed_m_s=round((ahead.speed + back.speed) / 2.0, 4),
        turn_rad_s=round((left.speed + right.speed) / 2.0, 4),
        delay_s=round(max(each.delay_s for each in (ahead, back, left, right)), 3),
        made=made,
    )
    for action in range(len(ACTIONS)):
        if ACTIONS[action].turn:
            driver.compare(action, found)
    return found


def calibrated(config: Config, link: Link, space_m: float, made: str, echo: Echo) -> Config:
    """The configuration with what was measured. Raises as `calibrate`."""
    try:
        robot = HardwareRobot(config.robot, link)
    except RobotFault as error:
        raise RobotMissing(f"robot calibrate: {error}") from error
    with closing(robot):
        found = calibrate(config, robot, link, space_m, made, echo)
    settings = config.robot.model_copy(update={"calibration": found})
    return config.model_copy(update={"robot": settings})


class _Drives:
    """Drives of one robot, each from standing to standing."""

    def __init__(self, config: Config, robot: Robot, link: Link, echo: Echo) -> None:
        self._config, self._robot, self._link, self._echo = config, robot, link, echo

    def measure(self, name: str, velocity: Velocity, driven_s: float) -> Response:
        """What the robot makes of one velocity."""
        tape = self.tape(velocity, driven_s)
        try:
            found = response(np.array(tape.times_s), tape.way(velocity), driven_s)
        except ValueError as error:
            raise ConfigError(f"robot calibrate: {name}: {error}") from error
        told = abs(velocity.forward_m_s or velocity.turn_rad_s)
        unit = "m/s" if velocity.forward_m_s else "rad/s"
        self._echo(
            f"{name:12} told {told:.3f} {unit}, does {found.speed:.3f} {unit} "
            f"after {found.delay_s:.2f} s"
        )
        return found

    def compare(self, action: int, found: CalibrationConfig) -> None:
        """Drive an action that turns. Raises ConfigError where it turns unlike on the spot."""
        velocity = action_velocity(self._config, action)
        tape = self.tape(velocity, TURN_S)
        turned = response(
            np.array(tape.times_s), tape.turn() * math.copysign(1.0, velocity.turn_rad_s), TURN_S
        ).speed
        self._echo(f"{ACTIONS[action].name:12} turns {turned:.3f} rad/s")
        _agree(f"turn rate on the spot and in {ACTIONS[action].name}", found.turn_rad_s, turned)
        self.tape(Velocity(-velocity.forward_m_s, 0.0, -velocity.turn_rad_s), TURN_S)  # go back

    def tape(self, velocity: Velocity, driven_s: float) -> Tape:
        """Poses from the command until the robot stands again."""
        start_s = self._wait_ready()
        tape = Tape([], [])
        try:
            self._robot.drive(velocity)
            self._watch(tape, start_s, driven_s)
            self._robot.drive(STANDSTILL)
            self._watch(tape, start_s, REST_S)
        except NotReady as error:
            raise RobotMissing(f"robot calibrate: {error}") from error
        finally:
            self._robot.drive(STANDSTILL)
        return tape

    def _watch(self, tape: Tape, start_s: float, duration_s: float) -> None:
        until_s, number = self._robot.now_s() + duration_s, 0
        while self._robot.now_s() < until_s:
            if self._robot.run(SLICE_S, stop_on_contact=True):
                raise ConfigError("robot calibrate: it touched something: it needs more room")
            reading = self._link.odometry.get()
            if reading is not None and reading.number != number:
                number = reading.number
                tape.times_s.append(reading.stamp_s - start_s)
                tape.poses.append(reading.value)

    def _wait_ready(self) -> float:
        """Wait until the robot may drive; returns when. Raises RobotMissing."""
        deadline_s = self._robot.now_s() + READY_S
        while True:
            try:
                self._robot.feel()
                return self._robot.now_s()
            except NotReady as error:
                if self._robot.now_s() > deadline_s:
                    raise RobotMissing(f"robot calibrate: {error}") from error
            try:
                self._robot.run(SLICE_S, stop_on_contact=True)
            except NotReady:
                continue


def _agree(what: str, first: float, second: float) -> None:
    if abs(first - second) > AGREE * max(first, second):
        raise ConfigError(
            f"robot calibrate: {what} disagree: {first:.3f} and {second:.3f}; is there enough room "
            "and a level floor?"
        )
