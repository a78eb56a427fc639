"""A ROS 2 robot's Zenoh network in front of an emulated base: `corridor emulate ros2`.

It is its own router and plays zenoh-bridge-ros2dds or nodes on rmw_zenoh, with the topics and
types that `robot.ros2` tells. Beside the robot's own keys there are two for tests, which only a
closed session takes away: `emulator/faults` (ask, with a JSON object to change some) and
`emulator/truth`.
"""

import json
import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from services.robot_driver.emulation.dynamics import CREATE3, ROBOTINO, STEP_S
from services.robot_driver.emulation.ros2_faults import TRUTH_KEY, Ros2Faults
from services.robot_driver.emulation.ros2_network import Network
from services.robot_driver.emulation.world import EmulatedRobot
from services.robot_driver.real import cdr, ros2_names, ros2_types
from services.robot_driver.real.link import Battery
from services.robot_driver.real.picture import RgbImage
from services.robot_driver.real.ros2_types import VelocityType
from shared.config import RobotConfig
from shared.errors import BadMessage, ConfigError, RouterMissing
from shared.facts import IMAGE_HEIGHT, IMAGE_WIDTH
from shared.foreign_bus import RawInbox, RawSample
from shared.threads import stop_on_signals

PERIODS_S = {"odometry": 0.05, "camera": 0.1, "bumper": 0.05, "battery": 0.5}
DUPLICATE_S = 1.0
MAX_DUPLICATES = 256
CLOCK_OFFSET_NS = -3_600 * 10**9
"""The robot's clock against ours: nobody sets one by the other."""
STALE_STAMP_NS = 500_000_000
"""Stamped velocities older than this are refused, as ROS's controllers do."""
SCALE = 2
"""Pictures are rendered smaller by this and scaled up."""
QUALITY = 80


class EmulatedRos2:
    """The robot and its network. Threads of its own; close it.

    Args:
        config: `ros2` tells topics and types (velocities: Twist, unless it is TwistStamped), the
            rest shape and camera of the robot.
        world: Where it drives.
        listen: Where clients connect, such as `tcp/127.0.0.1:7448`; port 0 takes a free one.
        faults: From the start.

    Raises:
        ConfigError: It cannot listen there, or there is no such world.
    """

    faults: Ros2Faults
    """What is wrong now."""
    endpoint: str
    """Where it listens."""

    def __init__(self, config: RobotConfig, world: str, listen: str, faults: Ros2Faults) -> None:
        self._ros = config.ros2
        create3 = self._ros.bumper_type == "HazardDetectionVector"
        self.dynamics = replace(CREATE3 if create3 else ROBOTINO, watchdog_s=CREATE3.watchdog_s)
        width = max(IMAGE_WIDTH, config.camera.render_width_px // SCALE)
        height = max(IMAGE_HEIGHT, config.camera.render_height_px // SCALE)
        camera = config.camera.model_copy(
            update={"render_width_px": width, "render_height_px": height}
        )
        self.robot = EmulatedRobot(
            world, self.dynamics, config.model_copy(update={"camera": camera})
        )
        self.counts: Counter[str] = Counter()
        """Commands that came, and those refused, by why."""
        self.faults = Ros2Faults()
        self._lock = threading.RLock()
        self._inbox = RawInbox()
        self._network: Network | None = None
        self._due_s = dict.fromkeys(PERIODS_S, time.monotonic())
        self._kept: dict[str, bytes] = {}
        self._picture: RgbImage | None = None
        self._told_pressed: bool | None = None
        self._again: deque[tuple[float, str, bytes, bytes]] = deque(maxlen=MAX_DUPLICATES)
        self._close_s, self._reopen_s = math.inf, -math.inf
        self._last_command_ns = 0
        try:
            self.endpoint = listen
            self._network = self._opened()
            self.endpoint = self._network.endpoint
        except BaseException:
            self.robot.close()
            raise
        self.change(faults.model_dump())
        self._done = threading.Event()
        self._threads = [
            threading.Thread(target=self._serve, name="emulated-ros2-in", daemon=True),
            threading.Thread(target=self._publish, name="emulated-ros2-out", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def change(self, changes: object) -> Ros2Faults:
        """Change some faults. Raises ValueError in one line."""
        with self._lock:
            before, now = self.faults, self.faults.changed(changes)
            self.faults = now
            self.robot.configure(odometry=now.odometry, watchdog_s=now.watchdog_s, scale=now.scale)
            if now.closed_s:  # after this was answered
                self._close_s = time.monotonic() + STEP_S
                self._reopen_s = self._close_s + now.closed_s
                self.faults = now.changed({"closed_s": 0.0})
            elif self._network is not None and before != now:
                self._network.listen(self._velocity_type)
                self._network.show_bumper(now.bumper != "silent")
            return now

    def truth(self) -> dict[str, Any]:
        """What the robot really does, and what it counted; times by the monotonic clock."""
        return {**self.robot.truth().tree(), "counts": dict(self.counts)}

    def close(self) -> None:
        """Leave the network and free the world. May be called twice."""
        self._done.set()
        self._inbox.wake()
        for thread in self._threads:
            thread.join(5.0)
        with self._lock:
            if self._network is not None:
                self._network.close()
                self._network = None
        self.robot.close()

    # ------------------------------------------------------------ network

    @property
    def _velocity_type(self) -> VelocityType | None:
        """What the base listens for now."""
        if self.faults.nobody_listens:
            return None
        stamped = (self._ros.velocity_type == "TwistStamped") != self.faults.wrong_type
        return "TwistStamped" if stamped else "Twist"

    def _opened(self) -> Network:
        network = Network(self.endpoint, self._ros, self._inbox)
        network.listen(self._velocity_type)
        network.show_bumper(self.faults.bumper != "silent")
        self._told_pressed = None
        return network

    def _serve(self) -> None:
        """Take commands and questions."""
        while not self._done.is_set():
            self._inbox.wait(0.1)
            while (sample := self._inbox.take("velocity")) is not None:
                self._take_command(sample)
            while (question := self._inbox.question()) is not None:
                try:
                    if question.key == TRUTH_KEY:
                        answer = self.truth()
                    else:
                        changes = json.loads(question.payload) if question.payload else {}
                        answer = self.change(changes).model_dump()
                    question.answer(json.dumps(answer).encode())
                except (ValueError, RecursionError) as error:
                    question.refuse(" ".join(str(error).split()))

    def _take_command(self, sample: RawSample) -> None:
        """Follow a command, as strictly as the real ones."""
        self.counts["commands"] += 1
        kind = self._velocity_type
        if kind is None:
            return
        attachment = ros2_names.unpacked(sample.attachment)
        if self._ros.transport == "rmw-zenoh" and attachment is None:
            self.counts["without attachment"] += 1
            return
        try:
            command = cdr.decode_velocity(sample.payload, kind)
        except BadMessage:
            self.counts["undecodable"] += 1
            return
        if command.stamp_ns:
            age_ns = self._now_ns() - command.stamp_ns
            if age_ns > STALE_STAMP_NS or command.stamp_ns <= self._last_command_ns:
                self.counts["stale stamp"] += 1
                return
            self._last_command_ns = command.stamp_ns
        self.robot.command(command.value)

    def _publish(self) -> None:
        """Publish what is due, 50 times a second."""
        while not self._done.wait(STEP_S):
            now_s = time.monotonic()
            self._keep_open(now_s)
            for name, period_s in PERIODS_S.items():
                if now_s >= self._due_s[name]:
                    self._due_s[name] = max(self._due_s[name] + period_s, now_s)
                    self._tell(name)
            while self._again and self._again[0][0] <= now_s:
                _, name, raw, attachment = self._again.popleft()
                self._send(name, raw, attachment)

    def _keep_open(self, now_s: float) -> None:
        """Close and open the session as told."""
        with self._lock:
            if self._network is not None and now_s >= self._close_s:
                self._network.close()
                self._network, self._close_s = None, math.inf
            elif self._network is None and now_s >= self._reopen_s:
                try:
                    self._network = self._opened()
                except ConfigError:  # the port is not free yet
                    self._reopen_s = now_s + 0.2

    def _tell(self, name: str) -> None:
        with self._lock:
            faults = self.faults
        state = getattr(faults, name, "")
        if state in ("silent", "muted"):
            return
        raw = self._kept.get(name) if state == "frozen" else None
        raw = raw or self._message(name, faults)
        network = self._network
        if raw is None or network is None:
            return
        self._kept[name] = raw
        wrong = faults.payload if faults.payload_of in ("all", name) else ""
        if wrong == "big-endian":
            kind = network.kinds[name]
            raw = ros2_types.encode(ros2_types.decode(raw, kind), kind, little_endian=False)
        elif wrong == "truncated":
            raw = raw[: len(raw) * 2 // 3]
        elif wrong == "padded":
            raw += bytes(3)
        attachment = b"" if faults.bare else network.attachment(name)
        self._send(name, raw, attachment)
        if faults.duplicates:
            self._again.append((time.monotonic() + DUPLICATE_S, name, raw, attachment))

    def _send(self, name: str, raw: bytes, attachment: bytes) -> None:
        network = self._network
        if network is not None:
            with suppress(RouterMissing):  # closed meanwhile
                network.publishers[name].put(raw, attachment)

    # ------------------------------------------------------------ messages

    def _message(self, name: str, faults: Ros2Faults) -> bytes | None:
        """What a sensor tells now; None: nothing."""
        stamp_ns, ros = self._now_ns(), self._ros
        if name == "odometry":
            now = self.robot.counted()
            return cdr.encode_odometry(now.odometry, now.velocity, stamp_ns)
        if name == "bumper":
            pressed = faults.bumper in ("stuck", "lifted") or self.robot.counted().contact
            if ros.bumper_on_change and pressed == self._told_pressed:
                return None
            first, self._told_pressed = self._told_pressed is None, pressed
            if ros.bumper_on_change and first and not pressed:
                return None  # it was so when the robot was switched on
            hazard = cdr.WHEEL_DROP if faults.bumper == "lifted" else cdr.BUMP
            return cdr.encode_bumper(pressed, ros.bumper_type, stamp_ns, hazard=hazard)
        if name == "battery":
            if not ros.battery_topic:
                return None
            self.robot.tell_battery(low=faults.battery_low)
            battery = Battery(faults.battery_low, 13.2 if faults.battery_low else 15.1)
            return cdr.encode_battery(battery, ros.battery_type, stamp_ns)
        return self._camera(stamp_ns - round(faults.camera_late_s * 1e9), faults)

    def _camera(self, stamp_ns: int, faults: Ros2Faults) -> bytes:
        picture = self._picture
        if picture is None or faults.camera != "restamped":
            small = self.robot.picture(faults.camera)
            size = (SCALE * small.shape[1], SCALE * small.shape[0])
            picture = np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_LINEAR), np.uint8)
            self._picture = picture
        if self._ros.camera_type == "Image":
            return cdr.encode_image(picture, stamp_ns)
        quality = [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
        done, data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), quality)
        assert done
        jpeg = np.asarray(data).tobytes()
        return cdr.encode_compressed_image(jpeg, stamp_ns, form="rgb8; jpeg compressed bgr8")

    def _now_ns(self) -> int:
        return time.time_ns() + CLOCK_OFFSET_NS + round(self.faults.clock_step_s * 1e9)


def run(
    config: RobotConfig, world: str, listen: str, faults: Ros2Faults, ready: Callable[[str], None]
) -> None:
    """Be a ROS 2 robot until Ctrl-C or SIGTERM; `ready` is called with the endpoint."""
    with stop_on_signals() as stop, closing(EmulatedRos2(config, world, listen, faults)) as robot:
        ready(robot.endpoint)
        while not stop.wait(0.2):  # a signal that another thread got is taken up only here
            pass
