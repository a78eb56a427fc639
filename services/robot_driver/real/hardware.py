"""A real robot behind any link: commands as leases, fresh sensors, stop on contact.

Three threads touch it: the driver's, one that watches the bumper, and one that asks the `Gate`
before every command, so a driver that hangs cannot keep a robot moving.
"""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, TypeVar

from services.robot_driver.real.gate import ZEROS, Gate
from services.robot_driver.real.link import Link, Newest, Reading
from services.robot_driver.real.odometry import MotionWatch, OdometryFrame
from services.robot_driver.robot import (
    STANDSTILL,
    Felt,
    NotReady,
    Pose,
    Robot,
    RobotFault,
    Sensed,
    Velocity,
)
from shared.config import RobotConfig

TICK_S = 0.01
"""How often lease, sensors and bumper are looked at while the robot moves."""
REFUSALS = 3
"""Failed commands in a row after which the robot counts as not fit to drive."""
READING_S = 3.0
"""Longest that a start waits for readings; without them it goes on, and the robot stands."""
CLOSING_S = 3.0
"""Longest that `close` tries to send its stops."""
T = TypeVar("T")
log = logging.getLogger(__name__)


class HardwareRobot(Robot):
    """A robot as `robot.Robot`, reached through a link, which is opened here and closed by `close`.

    clock: monotonic seconds, as the link stamps its readings with. Raises RobotFault when the robot
    did not answer in time. Sensors may answer later.
    """

    def __init__(
        self, config: RobotConfig, link: Link, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._config, self._link, self._clock = config, link, clock
        self._gate = Gate(config)
        self._changed = threading.Condition()
        """Guards the gate and everything below; told when something must be sent."""
        self._frame, self._motion = OdometryFrame(), MotionWatch(config.hardware.rest_s)
        self._pose, self._pose_number = Pose(0.0, 0.0, 0.0), 0
        self._driven = STANDSTILL
        """The velocity that the robot follows, as far as is known."""
        self._low = False
        """The battery was low when it was last known."""
        self._unsent, self._unsent_reason = 0, ""
        self._closing = self._closed = False
        self._due_s = clock()
        try:
            link.open()
            limit_s = clock() + READING_S
            slots: tuple[Newest[Any], ...] = (link.odometry, link.bumper, link.camera)
            for slot in slots:
                slot.wait(0, max(limit_s - clock(), 0.0))
        except BaseException:
            link.close()
            raise
        self._threads = [
            threading.Thread(target=self._send, name="command", daemon=True),
            threading.Thread(target=self._watch, name="bumper-watch", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    @property
    def faults(self) -> Counter[str]:
        """What went wrong so far, by what it was."""
        faults = Counter(dict(self._link.faults))
        faults["command: lease expired"] = self._gate.lease_stops
        faults["odometry: jumped"] = self._frame.jumps
        fitted = self._link.battery.note or self._link.battery.get()
        faults["battery: unknown"] = int(bool(fitted) and self.battery_low() is None)
        return +faults

    def battery_low(self) -> bool | None:
        """Whether the battery is low; None: nobody knows. A low one stays low until it is good."""
        reading, old_s = self._link.battery.get(), self._config.hardware.battery_stale_s
        if reading is not None and reading.value.low is not None:
            self._low = reading.value.low
            if self._clock() - reading.stamp_s <= old_s:
                return self._low
        return self._low or None

    def sense(self) -> Sensed:
        """The newest picture, odometry and bumper. Raises NotReady when the robot is not fit."""
        felt = self.feel()
        return Sensed(felt.pose, felt.contact, _there("camera", self._link.camera.get()))

    def feel(self) -> Felt:
        """The newest odometry and bumper. Raises NotReady when the robot is not fit to drive."""
        self._check()
        contact = _there("bumper", self._link.bumper.get())
        if not contact:
            self._touched(False)  # its own thread may come later than the driver
        return Felt(self._pose, contact)

    def drive(self, velocity: Velocity) -> None:
        """Set the velocity, leased until `run` renews it. Standstill is always taken.

        Raises RobotFault, the robot told to stop, beyond the limits; NotReady if it must not move.
        """
        with self._changed:
            try:
                self._gate.drive(velocity, self._clock())
            finally:
                self._changed.notify_all()
        if velocity.moving:
            self._check()

    def run(self, duration_s: float, *, stop_on_contact: bool) -> bool:
        """Let time pass while the bumper is watched. Raises NotReady, the robot told to stop.

        Without `stop_on_contact` a slow robot may move with a pressed bumper, as a recovery needs.
        """
        now_s = self._clock()
        self._due_s = max(self._due_s, now_s - duration_s) + duration_s
        contact = False
        while True:
            with self._changed:
                now_s = self._clock()
                self._gate.renew(now_s, regardless=not stop_on_contact)
                lapsed = self._gate.lapsed
                contact |= self._gate.handled()
                if contact and stop_on_contact:
                    self._gate.drive(STANDSTILL, now_s)
                    self._changed.notify_all()
                left_s = self._due_s - now_s
                if left_s > 0.0:
                    self._changed.wait(min(left_s, TICK_S))
            self._check(contact=contact)
            if lapsed:
                self.drive(STANDSTILL)
                raise NotReady("driver: hung for longer than a velocity is leased", contact=contact)
            if left_s <= 0.0:
                return contact

    def now_s(self) -> float:
        """The monotonic clock."""
        return self._clock()

    def state(self) -> dict[str, float | int | str]:
        """Nothing: a real robot stands where it stands."""
        return {}

    def restore(self, state: dict[str, float | int | str]) -> None:
        """Continue from nothing. Raises ValueError for a state of another kind of robot."""
        if state:
            raise ValueError("robot state: is of a simulated robot")

    def close(self) -> None:
        """Tell the robot to stop, several times, then let go of it. May be called twice."""
        with self._changed:
            if self._closed:
                return
            self._closed = self._closing = True
            self._gate.stop()
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(CLOSING_S)
        if not self._gate.silent:  # its own thread could not: try from here
            for _ in range(ZEROS):
                self._hand_over(STANDSTILL)
        self._link.close()

    def _check(self, *, contact: bool = False) -> None:
        """Raise NotReady, which tells of `contact`, when it must not move; it is told to stop."""
        with self._changed:
            self._gate.problem = problem = self._problem(self._clock())
            if self._gate.stuck:
                problem = "bumper: stays pressed, recovery could not free it"
            if problem:
                self._gate.drive(STANDSTILL, self._clock())
                self._changed.notify_all()
        if problem:
            raise NotReady(problem, contact=contact)

    def _problem(self, now_s: float) -> str:
        """Why the robot must not move now; empty when it may."""
        self._look(now_s)
        low = self.battery_low()  # whatever else is wrong: a low one is remembered
        link, ages = self._link, self._config.hardware
        for name, reading, oldest_s in (
            ("camera", link.camera.get(), ages.camera_stale_s),
            ("odometry", link.odometry.get(), ages.odometry_stale_s),
            ("bumper", link.bumper.get(), ages.bumper_stale_s),
        ):
            note = getattr(link, name).note
            why = f": {note}" if note else ""
            if reading is None:
                return f"{name}: no reading{why}"
            if now_s - reading.stamp_s > oldest_s:
                return f"{name}: nothing new for more than {oldest_s:g} s{why}"
        if low:
            return "battery: low"
        if obstacle := link.obstacle():
            return obstacle
        if self._unsent >= REFUSALS:
            return f"command: does not get through: {self._unsent_reason}"
        return self._motion.problem(now_s)

    def _look(self, now_s: float) -> None:
        """Compare the newest odometry with what the robot was told."""
        self._motion.told(self._driven, now_s, pressed=self._gate.pressed)
        reading, pushed = self._link.odometry.get(), self._motion.pushed
        if reading is None or reading.number == self._pose_number:
            return
        self._pose = self._frame.pose(reading.value, reading.stamp_s)
        self._pose_number = reading.number
        self._motion.moved(self._pose, reading.stamp_s, now_s)
        if self._motion.pushed and not pushed:
            self._gate.stop()  # who else drives it gets five stops against that

    def _watch(self) -> None:
        """Let the gate know of every reading of the bumper as soon as it comes."""
        number = 0
        while not self._closing:
            reading = self._link.bumper.wait(number, 0.2)
            if reading is None:
                continue
            number = reading.number
            self._touched(reading.value)

    def _touched(self, pressed: bool) -> None:
        with self._changed:
            self._gate.feel(pressed, self._clock())
            if pressed:
                self._changed.notify_all()

    def _send(self) -> None:
        """Send what the gate lets through, until the last stop is sent."""
        deadline_s = float("inf")
        while True:
            with self._changed:
                now_s = self._clock()
                if self._closing:
                    deadline_s = min(deadline_s, now_s + CLOSING_S / 2.0)
                    if self._gate.silent or now_s > deadline_s:
                        return
                velocity = self._due(now_s)
                if velocity is None:
                    busy = self._gate.wants_motion or not self._gate.silent
                    self._changed.wait(TICK_S if busy else 0.1)
                    continue
            self._hand_over(velocity)

    def _due(self, now_s: float) -> Velocity | None:
        """What the gate wants sent now; a link that cannot even say how it is lets nothing move."""
        if self._gate.wants_motion:
            try:
                self._gate.problem = self._problem(now_s)
            except Exception as error:
                log.exception("looking at the robot failed")
                self._gate.problem = f"link: {type(error).__name__}: {error}"
        return self._gate.due(now_s)

    def _hand_over(self, velocity: Velocity) -> None:
        """Send one velocity without holding up the others meanwhile."""
        reason = ""
        try:
            self._link.send(velocity)
        except RobotFault as error:
            reason = str(error)
        except Exception as error:  # the sender must never end silently
            log.exception("sending failed")
            reason = f"{type(error).__name__}: {error}"
        with self._changed:
            self._unsent = self._unsent + 1 if reason else 0
            self._unsent_reason = reason
            if not reason or not velocity.moving:
                self._driven = velocity
            self._gate.sent(velocity, self._clock(), arrived=not reason)


def _there(name: str, reading: Reading[T] | None) -> T:
    if reading is None:
        raise NotReady(f"{name}: no reading")  # it became void just now
    return reading.value
