"""A ROS 2 robot over Zenoh as `link.Link`: through zenoh-bridge-ros2dds or through rmw_zenoh.

One thread of the link decodes. Liveliness tokens tell types, never that a robot lives: those of a
cut-off robot stay for ten seconds.
"""

import logging
import secrets
import threading
import time
from typing import cast

from services.robot_driver.real import cdr, ros2_names, ros2_types
from services.robot_driver.real.ros2_names import Attachment
from services.robot_driver.real.ros2_sensors import SENSORS, Ros2Sensors
from services.robot_driver.real.ros2_types import VelocityType
from services.robot_driver.robot import RobotFault, Velocity
from shared.config import Config
from shared.errors import RouterMissing
from shared.foreign_bus import ForeignBus, RawInbox, RawPublisher

log = logging.getLogger(__name__)
KEPT = {"bumper": 64, "odometry": 1, "battery": 1, "camera": 1}
"""Samples that wait to be decoded: of the bumper all, a short touch counts; else the newest."""
TICK_S = 0.1
"""Longest that the link's thread waits for the network."""
RETRY_S = 0.1
_S_NS = 1_000_000_000


class Ros2Link(Ros2Sensors):
    """A ROS 2 robot as `link.Link`; `robot.ros2` says where it is and how its topics are called."""

    def __init__(self, config: Config) -> None:
        super().__init__(config.robot.ros2)
        self._hardware = config.robot.hardware
        self._epoch_s = time.time() - time.monotonic()
        self._changes_seen = -1
        self._inbox = RawInbox()
        self._bus: ForeignBus | None = None
        self._publishers: dict[str, RawPublisher] = {}
        self._sending = threading.Lock()
        self._sequence = dict.fromkeys(ros2_names.VELOCITY_TYPES, 0)
        self._gid = {name: secrets.token_bytes(16) for name in ros2_names.VELOCITY_TYPES}
        self._last_stamp_ns = 0
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ros2-link", daemon=True)

    def open(self) -> None:
        """Connect and begin to read. Raises RobotFault when no router of the robot answers."""
        self._bus = bus = self._connect()
        for key in ros2_names.TOKEN_KEYS:
            bus.watch(self._inbox, key)
        for name, kind in self._kinds.items():
            if name in self._topics:
                bus.subscribe(
                    self._inbox,
                    name,
                    ros2_types.key_of(self._ros, self._topics[name], kind, ros2_names.ANY_HASH),
                    max_bytes=ros2_types.MAX_BYTES[kind],
                    keep=KEPT[name],
                )
        for kind in ros2_names.VELOCITY_TYPES:
            key = ros2_types.key_of(self._ros, self._topics["velocity"], kind)
            self._publishers[kind] = bus.publisher(key)
        self._thread.start()

    def obstacle(self) -> str:
        """Why the robot cannot be commanded now, in one line; empty when it can."""
        return self._velocity_type()[1] or self._wrong_sensor()

    def send(self, velocity: Velocity) -> None:
        """Publish one command; motion only where `obstacle` is empty.

        Raises RobotFault, also for a stop that was published while nobody is known to listen.
        """
        kind, obstacle = self._velocity_type()
        try:
            if kind and not (obstacle and velocity.moving):
                self._publish(velocity, kind)
            if obstacle:
                raise RobotFault(obstacle)
        except RobotFault as error:
            self.count("command", str(error))
            raise

    def _publish(self, velocity: Velocity, kind: VelocityType) -> None:
        with self._sending:
            now_ns = time.time_ns()
            self._sequence[kind] += 1
            attachment = b""
            if self._ros.transport == "rmw-zenoh":
                attachment = ros2_names.packed(
                    Attachment(self._sequence[kind], now_ns, self._gid[kind])
                )
            try:
                raw = cdr.encode_velocity(velocity, kind, self._stamp_ns(time.monotonic()))
                self._publishers[kind].put(raw, attachment)
            except (ValueError, RouterMissing) as error:
                raise RobotFault(str(error)) from error

    def close(self) -> None:
        """Stop reading and disconnect; sends nothing. May be called twice."""
        self._done.set()
        self._inbox.wake()
        if self._thread.is_alive():
            self._thread.join(5.0)
        if self._bus is not None:
            self._bus.close()

    def _velocity_type(self) -> tuple[VelocityType, str]:
        """Which type to send (empty: unknown), and what speaks against sending."""
        if not self._publishers or self._done.is_set():
            return cast(VelocityType, ""), "not connected to the robot"
        topic = self._topics["velocity"]
        chosen, obstacle = ros2_names.velocity_type(
            self._ros.velocity_type,
            topic,
            ros2_names.types_on(self._endpoints, "listens", topic),
            {kind: publisher.matching for kind, publisher in self._publishers.items()},
            self._ros.transport,
        )
        return cast(VelocityType, chosen), obstacle

    def _connect(self) -> ForeignBus:
        limit_s = time.monotonic() + self._hardware.open_timeout_s
        while True:
            try:
                return ForeignBus(self._ros.endpoint)
            except RouterMissing as error:
                if time.monotonic() > limit_s:
                    raise RobotFault(
                        f"robot.ros2.endpoint: {error} within robot.hardware.open_timeout_s "
                        f"({self._hardware.open_timeout_s:g} s)"
                    ) from error
                time.sleep(RETRY_S)

    def _run(self) -> None:
        while not self._done.is_set():
            hold_s = self._touch_until_s - time.monotonic()
            self._inbox.wait(hold_s if 0.0 < hold_s < TICK_S else TICK_S)
            while self._turn() and not self._done.is_set():
                pass
            self._count_refused()
            self.explain()

    def _turn(self) -> bool:
        """Take the most urgent sample; False when there is none."""
        if self._changes_seen != self._inbox.changes:
            self._changes_seen = self._inbox.changes
            tokens = (ros2_names.parsed_token(t, self._ros.domain) for t in self._inbox.tokens())
            self._endpoints = frozenset(endpoint for endpoint in tokens if endpoint)
        for name in SENSORS:
            if name == "bumper" and time.monotonic() < self._touch_until_s:
                continue
            sample = self._inbox.take(name)
            if sample is None:
                continue
            self.take(name, sample, time.monotonic())
            return True
        return False

    def _count_refused(self) -> None:
        """What the inbox did not take was not read either."""
        for name, count in self._inbox.refused.copy().items():
            fault = f"{name}: too long or too many"
            if name in KEPT and count > self.faults[fault]:
                self.refuse(name, "too long or too many")
                self.faults[fault] = count

    def _stamp_ns(self, now_s: float) -> int:
        """Now, on the robot's clock, never going back, which bases refuse; 0 (now) without."""
        stamp_ns = self._robot_clock.stamp_ns(now_s)
        if stamp_ns <= 0:
            return 0
        if self._last_stamp_ns - _S_NS < stamp_ns <= self._last_stamp_ns:
            stamp_ns = self._last_stamp_ns + 1
        self._last_stamp_ns = stamp_ns
        return stamp_ns
