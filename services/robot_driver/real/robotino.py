"""A Festo Robotino 3 or 4 over its REST interface: one thread per sensor, newest reading wins."""

from __future__ import annotations

import hashlib
import json
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Final

import httpx

from services.robot_driver.real import robotino_replies as replies
from services.robot_driver.real.link import Battery, Newest
from services.robot_driver.real.robotino_replies import BadReply
from services.robot_driver.robot import Pose, RobotFault, Velocity
from shared.config import Config
from shared.errors import ConfigError
from shared.messages import ImageArray

log = logging.getLogger(__name__)

SERVER_SPEED_M_S, SERVER_TURN_RAD_S = 2.0, 3.0
"""The robot's server refuses faster commands instead of cutting them."""
LABEL: Final = {"sid": "corridor"}
"""Names this client to the robot; it needs no login."""


class RobotinoLink:
    """A Robotino as `link.Link`.

    Args:
        config: `robot.robotino` says where it is and how often its sensors are read.

    Raises:
        ConfigError: The address cannot be one.
    """

    def __init__(self, config: Config) -> None:
        robotino = config.robot.robotino
        self._config = robotino
        self._address = f"http://{robotino.address}"
        self.camera: Newest[ImageArray] = Newest()
        self.odometry: Newest[Pose] = Newest()
        self.bumper: Newest[bool] = Newest()
        self.battery: Newest[Battery] = Newest()
        self.faults: Counter[str] = Counter()
        self._counting = threading.Lock()
        self._done = threading.Event()
        self._threads: list[threading.Thread] = []
        self._command_s = min(robotino.timeout_s, config.robot.hardware.command_period_s)
        port = robotino.address.rpartition(":")[2]
        if port.isdecimal() and int(port) > 65535:
            raise ConfigError(
                f"robot.robotino.address: expected a port up to 65535, got {robotino.address!r}"
            )
        self._commands = self._client(self._command_s)
        self._sequence: int | None = None
        self._picture = b""

    def open(self) -> None:
        """Begin to read; the robot may answer later."""
        logging.getLogger("httpx").setLevel(logging.WARNING)  # a line for each of 30 a second
        c = self._config
        for name, path, period_s, limit, take in (
            (
                "camera",
                "/cam0",
                c.camera_period_s,
                replies.MAX_JPEG_BYTES,
                self._take_picture,
            ),
            ("odometry", "/data/odometry", c.sensor_period_s, *self._json(self._take_odometry)),
            ("bumper", "/data/bumper", c.sensor_period_s, *self._json(self._take_bumper)),
            (
                "battery",
                "/data/powermanagement",
                c.battery_period_s,
                *self._json(self._take_battery),
            ),
        ):
            thread = threading.Thread(
                target=self._poll, args=(name, path, period_s, limit, take), name=name, daemon=True
            )
            self._threads.append(thread)
            thread.start()

    def obstacle(self) -> str:
        """Empty: a Robotino takes commands whenever it answers."""
        return ""

    def send(self, velocity: Velocity) -> None:
        """Put one velocity, cut to what the robot's server accepts. Raises RobotFault."""
        wanted = (
            _cut(velocity.forward_m_s, SERVER_SPEED_M_S),
            _cut(velocity.left_m_s, SERVER_SPEED_M_S),
            _cut(velocity.turn_rad_s, SERVER_TURN_RAD_S),
        )
        try:
            content = json.dumps(wanted, allow_nan=False).encode()
            status = self._put(content)
        except (httpx.HTTPError, httpx.StreamError, ValueError, RuntimeError) as error:
            raise self._fault("command", _reason(error)) from error
        if status != httpx.codes.OK:
            raise self._fault("command", f"status {status}")

    def _put(self, content: bytes) -> int:
        """Send a command; the status is answer enough, its body is read only while it comes."""
        headers = {"Content-Type": "application/json"}
        end_s, size = time.monotonic() + self._command_s, 0
        with self._commands.stream(
            "PUT", "/data/omnidrive", params=LABEL, content=content, headers=headers
        ) as reply:
            for chunk in reply.iter_raw():  # to its end, so that the connection stays open
                size += len(chunk)
                if size > replies.MAX_JSON_BYTES or time.monotonic() > end_s:
                    break
            return reply.status_code

    def close(self) -> None:
        """Stop reading and disconnect. May be called twice."""
        self._done.set()
        for thread in self._threads:
            thread.join(4.0 * self._config.timeout_s + 1.0)
        self._commands.close()

    # ------------------------------------------------------------ reading

    @staticmethod
    def _json(take: Callable[[bytes], None]) -> tuple[int, Callable[[bytes], None]]:
        return replies.MAX_JSON_BYTES, take

    def _poll(
        self, name: str, path: str, period_s: float, limit: int, take: Callable[[bytes], None]
    ) -> None:
        """Read one sensor for ever, each time a period after the last began."""
        with self._client(self._config.timeout_s) as client:
            due_s = time.monotonic()
            while not self._done.wait(max(due_s - time.monotonic(), 0.0)):
                due_s = max(due_s + period_s, time.monotonic())
                try:
                    take(self._fetch(client, path, limit))
                except BadReply as error:
                    self._fault(name, str(error))
                except (httpx.HTTPError, httpx.StreamError, RuntimeError) as error:
                    self._fault(name, _reason(error))
                except Exception as error:  # one odd answer must not end all reading
                    log.exception("%s: could not be read", name)
                    self._fault(name, type(error).__name__)

    def _fetch(self, client: httpx.Client, path: str, limit: int) -> bytes:
        """The body of one answer, at most `limit` bytes of it. Raises BadReply, HTTPError."""
        body = bytearray()
        end_s = time.monotonic() + 4.0 * self._config.timeout_s
        with client.stream("GET", path, params=LABEL) as reply:
            if reply.status_code != httpx.codes.OK:
                raise BadReply(f"status {reply.status_code}")
            for chunk in reply.iter_bytes():
                body += chunk
                if len(body) > limit:
                    raise BadReply("too large")
                if time.monotonic() > end_s:
                    raise BadReply("timeout")
        return bytes(body)

    def _take_picture(self, body: bytes) -> None:
        """A picture equal to the last one, byte by byte, is the last one: sensors have noise."""
        digest = hashlib.blake2b(body, digest_size=16).digest()
        if digest != self._picture:
            self.camera.put(replies.camera(body), time.monotonic())
            self._picture = digest

    def _take_odometry(self, body: bytes) -> None:
        """Odometry with the sequence number of the last one is no new reading."""
        pose, sequence = replies.odometry(body)
        if sequence != self._sequence:
            self._sequence = sequence
            self.odometry.put(pose, time.monotonic())

    def _take_bumper(self, body: bytes) -> None:
        self.bumper.put(replies.bumper(body), time.monotonic())

    def _take_battery(self, body: bytes) -> None:
        self.battery.put(replies.battery(body), time.monotonic())

    def _client(self, timeout_s: float) -> httpx.Client:
        """A connection of its own that is kept open; proxies of the environment are not asked."""
        return httpx.Client(
            base_url=self._address,
            timeout=timeout_s,
            limits=httpx.Limits(max_connections=1, max_keepalive_connections=1),
            trust_env=False,
            follow_redirects=False,
        )

    def _fault(self, name: str, reason: str) -> RobotFault:
        with self._counting:
            self.faults[f"{name}: {reason}"] += 1
        return RobotFault(f"{name}: {reason}")


def _reason(error: Exception) -> str:
    if isinstance(error, httpx.TimeoutException):
        return "timeout"
    if isinstance(error, httpx.NetworkError):
        return "no connection"
    return "broken answer"


def _cut(value: float, most: float) -> float:
    return max(-most, min(most, value))
