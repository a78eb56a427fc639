"""A ROS 2 robot over Zenoh as `link.Link`: through zenoh-bridge-ros2dds or through rmw_zenoh.

Zenoh's threads put bytes into an inbox; one thread of the link decodes and judges them. What the
robot says counts only while it is fresh: liveliness tokens tell types, never that a robot lives
(a cut-off robot's tokens stay for ten seconds).
"""

from __future__ import annotations

import logging
import math
import secrets
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Literal, cast

from services.robot_driver.real import cdr, ros2_names, ros2_types
from services.robot_driver.real.freshness import Pictures, Sequences, Stamps
from services.robot_driver.real.link import Battery, Newest
from services.robot_driver.real.ros2_names import Attachment, Endpoint
from services.robot_driver.real.ros2_types import VelocityType
from services.robot_driver.robot import Pose, RobotFault, Velocity
from shared.config import Config
from shared.errors import BadMessage, RouterMissing
from shared.foreign_bus import ForeignBus, RawInbox, RawPublisher, RawSample
from shared.messages import ImageArray
from shared.rl.preprocess import preprocess

log = logging.getLogger(__name__)
Sensor = Literal["bumper", "odometry", "battery", "camera"]
KEPT = {"bumper": 64, "odometry": 1, "battery": 1, "camera": 1}
"""Samples that wait to be decoded: of the bumper all, a short touch counts; else the newest."""
TOUCH_S = 0.03
"""A touch is shown at least this long, so that whoever watches the slot sees it."""
TICK_S = 0.1
"""Longest that the link's thread waits for the network."""
RETRY_S = 0.1
_S_NS = 1_000_000_000


class Ros2Link:
    """A ROS 2 robot as `link.Link`.

    A bumper that is published on change alone is silent for hours. It counts as released from the
    start when the network tells that somebody publishes it, and every new odometry then shows that
    the robot still talks and had nothing new to tell. Without such a publisher its bumper is
    unknown until it is first heard, and the robot does not drive.

    Args:
        config: `robot.ros2` says where the robot is and what its topics are called.
    """

    def __init__(self, config: Config) -> None:
        self._ros, self._hardware = config.robot.ros2, config.robot.hardware
        self.camera: Newest[ImageArray] = Newest()
        self.odometry: Newest[Pose] = Newest()
        self.bumper: Newest[bool] = Newest()
        self.battery: Newest[Battery] = Newest()
        self.faults: Counter[str] = Counter()
        parts = ("velocity", "bumper", "odometry", "camera", "battery")
        topics = {part: getattr(self._ros, f"{part}_topic") for part in parts}
        self._topics = {part: self._topic(topic) for part, topic in topics.items() if topic}
        self._kinds: dict[str, str] = {
            "bumper": self._ros.bumper_type,
            "odometry": "Odometry",
            "camera": self._ros.camera_type,
            "battery": self._ros.battery_type,
        }
        self._stamps = {name: Stamps() for name in KEPT}
        self._sequences = {name: Sequences() for name in KEPT}
        self._pictures = Pictures()
        self._endpoints: frozenset[Endpoint] = frozenset()
        self._changes_seen = -1
        self._pressed: bool | None = None
        self._bumper_told = False
        """Whether the network ever told of somebody who publishes the bumper."""
        self._touch_until_s = -math.inf
        self._robot_clock: tuple[int, float] | None = None
        """Newest stamp of the odometry, and our clock when it arrived."""
        self._inbox = RawInbox()
        self._bus: ForeignBus | None = None
        self._publishers: dict[str, RawPublisher] = {}
        self._sending = threading.Lock()
        self._sequence = dict.fromkeys(ros2_names.VELOCITY_TYPES, 0)
        self._gid = {name: secrets.token_bytes(16) for name in ros2_names.VELOCITY_TYPES}
        self._last_stamp_ns = 0
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ros2-link", daemon=True)

    # ------------------------------------------------------------ link.Link

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
                    self._key(name, kind, ros2_names.ANY_HASH),
                    max_bytes=ros2_types.MAX_BYTES[kind],
                    keep=KEPT[name],
                )
        for kind in ros2_names.VELOCITY_TYPES:
            self._publishers[kind] = bus.publisher(self._key("velocity", kind, self._hash(kind)))
        self._thread.start()

    def obstacle(self) -> str:
        """Why the robot cannot be commanded now, in one line; empty when it can."""
        return self._velocity_type()[1] or self._wrong_sensor()

    def send(self, velocity: Velocity) -> None:
        """Publish one command; motion only where `obstacle` is empty.

        Raises:
            RobotFault: Also for a stop that was published while nobody is known to listen.
        """
        kind, obstacle = self._velocity_type()
        try:
            if kind and not (obstacle and velocity.moving):
                self._publish(velocity, kind)
            if obstacle:
                raise RobotFault(obstacle)
        except RobotFault as error:
            self.faults[f"command: {str(error).split(':')[0]}"] += 1
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

    # ------------------------------------------------------------ names and types

    def _topic(self, topic: str) -> str:
        return ros2_names.full_topic(self._ros.namespace, topic)

    def _hash(self, kind: str) -> str:
        if self._ros.distribution == "humble":
            return ros2_names.NO_HASH
        return ros2_types.type_hash(kind)

    def _key(self, name: str, kind: str, type_hash: str) -> str:
        topic = self._topics[name]
        if self._ros.transport == "bridge":
            return topic
        return ros2_names.rmw_key(self._ros.domain, topic, ros2_types.FULL_NAMES[kind], type_hash)

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

    def _wrong_sensor(self) -> str:
        """A sensor that the robot publishes as another type; what it sends would mean nothing."""
        for name, topic in self._topics.items():
            told = ros2_names.types_on(self._endpoints, "publishes", topic)
            if name != "velocity" and told and ros2_types.FULL_NAMES[self._kinds[name]] not in told:
                types = " and ".join(sorted(ros2_names.short(full) for full in told))
                return f"robot publishes {types} on {topic}, configured {self._kinds[name]}"
        return ""

    # ------------------------------------------------------------ the link's thread

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
        takers: dict[str, Callable[[RawSample], None]] = {
            "bumper": self._take_bumper,
            "odometry": self._take_odometry,
            "battery": self._take_battery,
            "camera": self._take_camera,
        }
        while not self._done.is_set():
            hold_s = self._touch_until_s - time.monotonic()
            self._inbox.wait(hold_s if 0.0 < hold_s < TICK_S else TICK_S)
            while self._turn(takers) and not self._done.is_set():
                pass
            for name, count in self._inbox.refused.copy().items():
                if count:
                    self.faults[f"{name}: too long or too many"] = count

    def _turn(self, takers: dict[str, Callable[[RawSample], None]]) -> bool:
        """Take the most urgent sample; False when there is none."""
        if self._changes_seen != self._inbox.changes:
            self._changes_seen = self._inbox.changes
            tokens = (ros2_names.parsed_token(t, self._ros.domain) for t in self._inbox.tokens())
            self._endpoints = frozenset(endpoint for endpoint in tokens if endpoint)
        for name, take in takers.items():
            if name == "bumper" and time.monotonic() < self._touch_until_s:
                continue
            sample = self._inbox.take(name)
            if sample is None:
                continue
            try:
                take(sample)
            except BadMessage as error:
                self._fault(name, error)
            except Exception as error:  # one odd message must not end all reading
                log.exception("%s: could not be taken", name)
                self.faults[f"{name}: {type(error).__name__}"] += 1
            return True
        return False

    def _take_bumper(self, sample: RawSample) -> None:
        read = cdr.decode_bumper(sample.payload, self._ros.bumper_type)
        if not self._new("bumper", sample, read.stamp_ns):
            return
        if read.value and not self._pressed:
            self._touch_until_s = time.monotonic() + TOUCH_S
        self._pressed = read.value
        self.bumper.put(read.value, sample.arrived_s)

    def _take_odometry(self, sample: RawSample) -> None:
        read = cdr.decode_odometry(sample.payload)
        if not self._new("odometry", sample, read.stamp_ns):
            return
        self._robot_clock = (read.stamp_ns, sample.arrived_s)
        self.odometry.put(read.value, sample.arrived_s)
        if self._ros.bumper_on_change:
            self._confirm_bumper(sample.arrived_s)

    def _confirm_bumper(self, arrived_s: float) -> None:
        """The robot talks: its bumper, told on change alone, is still as it was last told."""
        there = ros2_names.types_on(self._endpoints, "publishes", self._topics["bumper"])
        self._bumper_told |= bool(there)
        if self._pressed is None and there:
            self._pressed = False
        # Where the network tells who publishes, a publisher that went takes the all-clear with it.
        if self._pressed is not None and (there or not (self._bumper_told or self._endpoints)):
            self.bumper.put(self._pressed, arrived_s)

    def _take_battery(self, sample: RawSample) -> None:
        read = cdr.decode_battery(sample.payload, self._ros.battery_type)
        if self._new("battery", sample, read.stamp_ns):
            self.battery.put(read.value, sample.arrived_s)

    def _take_camera(self, sample: RawSample) -> None:
        read = cdr.decode_camera(sample.payload, self._ros.camera_type)
        if not self._new("camera", sample, read.stamp_ns):
            return
        here = self.odometry.get()
        if not self._pictures.new(read.value, here.value if here else None):
            raise BadMessage("the same picture although the robot moved")
        self.camera.put(preprocess(read.value), sample.arrived_s)

    def _new(self, name: str, sample: RawSample, stamp_ns: int) -> bool:
        """Whether a sample tells something new; one that repeats or comes late is counted."""
        new = True
        if self._ros.transport == "rmw-zenoh":
            attachment = ros2_names.unpacked(sample.attachment)
            if attachment is None:
                raise BadMessage("without the attachment of rmw_zenoh")
            new = self._sequences[name].new(attachment.gid, attachment.sequence)
        new &= self._stamps[name].new(stamp_ns)
        if not new:
            self._fault(name, BadMessage("repeated or late"))
        return new

    def _fault(self, name: str, error: BadMessage) -> None:
        """Count by reason; log when the count is 1, 2, 4, 8 ...: visible, never a flood."""
        fault = f"{name}: {str(error).split(':')[0]}"
        self.faults[fault] += 1
        count = self.faults[fault]
        if count & (count - 1) == 0:
            log.warning("%s refused (%d so far): %s", name, count, error)

    # ------------------------------------------------------------ the robot's clock

    def _stamp_ns(self, now_s: float) -> int:
        """Now, on the robot's clock as its odometry shows it; 0 (which means now) without.

        Bases refuse stamps that are old or go back, and nobody sets our clock by theirs.
        """
        if self._robot_clock is None or self._robot_clock[0] <= 0:
            return 0
        stamp_ns, arrived_s = self._robot_clock
        stamp_ns += round((now_s - arrived_s) * _S_NS)
        if self._last_stamp_ns - _S_NS < stamp_ns <= self._last_stamp_ns:
            stamp_ns = self._last_stamp_ns + 1
        self._last_stamp_ns = stamp_ns
        return stamp_ns
