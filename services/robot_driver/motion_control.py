"""Moves one robot by actions, motions and recoveries, always within the limits of `safety.py`."""

import math
from collections.abc import Iterator
from contextlib import contextmanager

from services.robot_driver.host import Host
from services.robot_driver.recovery import Halted, WatchedRobot, back_off, let_go
from services.robot_driver.robot import STANDSTILL, NotReady, Robot, Velocity
from services.robot_driver.safety import Safety
from shared.config import Config
from shared.facts import ACTIONS
from shared.messages import Motion
from shared.rl.draws import generator

SLICE_S = 0.02
"""Realtime: how often commands, bumper and deadman are looked at within a period."""


def action_velocity(config: Config, action: int) -> Velocity:
    """Body velocity of an action (A21): forward, and turning where the action turns."""
    turn_rad_s = ACTIONS[action].turn * config.robot.turn_rad_s
    return Velocity(config.robot.speed_m_s, 0.0, turn_rad_s)


def motion_velocity(config: Config, motion: Motion) -> Velocity:
    """Body velocity of a motion that is no action: turning as in actions (A45), or creeping."""
    robot = config.robot
    if motion in ("turn-left", "turn-right"):
        return Velocity(0.0, 0.0, robot.turn_rad_s if motion == "turn-left" else -robot.turn_rad_s)
    sense = {"forward": 1.0, "back": -1.0}.get(motion, 0.0)
    return Velocity(sense * robot.recovery_speed_m_s, 0.0, 0.0)


class MotionControl:
    """Sets a robot's velocity and stops it: at contact, when halted, when the deadman expires."""

    def __init__(self, config: Config, robot: Robot, safety: Safety, host: Host) -> None:
        self._config, self._robot, self._safety, self.host = config, robot, safety, host
        self._moving = False
        self.motion: Motion = ""
        """The motion in force, or the one just over. It is empty for an action."""

    def start_action(self, action: int) -> None:
        """Begin to drive an action."""
        self.motion = ""
        self._start(action_velocity(self._config, action))

    def start_motion(self, motion: Motion) -> bool:
        """Begin to turn or to creep. False, standing still, where the bumper is pressed."""
        if self._robot.feel().contact:
            self.halt()
            return False
        self.motion = motion
        self._start(motion_velocity(self._config, motion))
        return True

    def advance(self, duration_s: float) -> bool:
        """Let time pass; True at contact, where the robot has already stopped.

        With the recovery `none` contact does not stop an action, but it does stop a motion.
        """
        stop = self._config.robot.recovery != "none" or self.motion != ""
        contact = self._robot.run(duration_s, stop_on_contact=stop)
        if contact and stop:
            self._drive(STANDSTILL)
        if self._moving and self._safety.halted:
            self._drive(STANDSTILL)
        elif self._moving and self._safety.expired(self._robot.now_s()):
            self._safety.deadman_stops += 1
            self._drive(STANDSTILL)
        return contact

    def halt(self) -> None:
        """Stand still now."""
        self.motion = ""
        self._drive(STANDSTILL)

    def back_off(self, sequence: int) -> bool:
        """Retreat from a bump by real motion, then turn to a random heading (E11).

        The heading is drawn from the seed and the sequence number. False: it broke off.
        """
        robot = self._config.robot
        draw = generator(self._config.run.seed, "recovery", robot.id, sequence)
        heading_rad = float(draw.uniform(-math.pi, math.pi))
        with self._recovering() as watched:
            back_off(watched, robot, heading_rad)
            return True
        return False

    def let_go(self) -> None:
        """Drive back the way the robot came, until the bumper is free."""
        direction = {"forward": -1.0, "back": 1.0}.get(self.motion)
        if direction is not None:
            with self._recovering() as watched:
                let_go(watched, self._config.robot, direction)

    @contextmanager
    def _recovering(self) -> Iterator[WatchedRobot]:
        """A robot that moves by itself, within the limits and watched, until the block ends."""
        slice_s = SLICE_S if self._config.robot.timing == "realtime" else None
        watched = WatchedRobot(self._robot, self._safety, self.host, slice_s)
        try:
            yield watched
            if self._config.robot.kind != "sim":  # it still moves when told to stop
                watched.run(self._config.robot.hardware.rest_s, stop_on_contact=False)
        except Halted:  # it stands where it was stopped; the operator's `clear`, or the restart,
            pass  # tells the actor
        except NotReady:  # it stands; the next look tells why, and the actor
            self.halt()
        self._moving = False

    def _start(self, velocity: Velocity) -> None:
        self._drive(self._safety.allow(velocity, self._robot.now_s()))

    def _drive(self, velocity: Velocity) -> None:
        self._robot.drive(velocity)
        self._moving = velocity.moving
