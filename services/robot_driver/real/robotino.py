"""A Festo Robotino 3 or 4 over its REST interface: one thread per sensor, newest reading wins."""

import http.client
import json
import logging
import threading
import time
from http import HTTPStatus

from services.robot_driver.real import robotino_replies as replies
from services.robot_driver.real.freshness import Pictures
from services.robot_driver.real.http_call import Connection
from services.robot_driver.real.link import Slots
from services.robot_driver.real.picture import decoded
from services.robot_driver.robot import RobotFault, Velocity
from shared.config import Config
from shared.errors import BadMessage, ConfigError
from shared.rl.preprocess import preprocess

log = logging.getLogger(__name__)

MOST = (2.0, 2.0, 3.0)
"""m/s ahead and aside, rad/s. The robot's server refuses faster commands."""
LABEL = "?sid=corridor"
"""Names this client to the robot; it needs no login."""


class RobotinoLink(Slots):
    """A Robotino as `link.Link`. Raises ConfigError for an address that cannot be one."""

    def __init__(self, config: Config) -> None:
        super().__init__()
        self._config = robotino = config.robot.robotino
        self._open_timeout_s = config.robot.hardware.open_timeout_s
        self._answered, self._done = threading.Event(), threading.Event()
        self._threads: list[threading.Thread] = []
        port = robotino.address.rpartition(":")[2]
        if port.isdecimal() and int(port) > 65535:
            raise ConfigError(
                f"robot.robotino.address: expected a port up to 65535, got {robotino.address!r}"
            )
        command_s = min(robotino.timeout_s, config.robot.hardware.command_period_s)
        self._commands = Connection(robotino.address, command_s)
        self._sequence: float | None = None
        self._pictures = Pictures()

    def open(self) -> None:
        """Begin to read. Raises RobotFault when nothing at all is answered in time."""
        c = self._config
        for name, path, period_s, limit in (
            ("camera", "/cam0", c.camera_period_s, replies.MAX_JPEG_BYTES),
            ("odometry", "/data/odometry", c.sensor_period_s, replies.MAX_JSON_BYTES),
            ("bumper", "/data/bumper", c.sensor_period_s, replies.MAX_JSON_BYTES),
            ("battery", "/data/powermanagement", c.battery_period_s, replies.MAX_JSON_BYTES),
        ):
            polled = (name, path + LABEL, period_s, limit)
            thread = threading.Thread(target=self._poll, args=polled, name=name, daemon=True)
            self._threads.append(thread)
            thread.start()
        if not self._answered.wait(self._open_timeout_s):
            with self._counting:
                seen = ", ".join(f"{fault} ({n})" for fault, n in self.faults.most_common(3))
            raise RobotFault(
                f"robot: no answer from {c.address} within robot.hardware.open_timeout_s "
                f"({self._open_timeout_s:g} s); {seen}"
            )

    def obstacle(self) -> str:
        """Empty: a Robotino takes commands whenever it answers."""
        return ""

    def send(self, velocity: Velocity) -> None:
        """Put one velocity, cut to what the robot's server accepts. Raises RobotFault."""
        parts = (velocity.forward_m_s, velocity.left_m_s, velocity.turn_rad_s)
        wanted = [max(-most, min(most, part)) for part, most in zip(parts, MOST, strict=True)]
        try:
            content = json.dumps(wanted, allow_nan=False).encode()
            path, limit = "/data/omnidrive" + LABEL, replies.MAX_JSON_BYTES
            status, _ = self._commands.call("PUT", path, content, limit, whole=False)
        except (OSError, http.client.HTTPException, ValueError) as error:
            raise self._fault(_reason(error)) from error
        if status != HTTPStatus.OK:
            raise self._fault(f"status {status}")

    def close(self) -> None:
        """Stop reading and disconnect. May be called twice."""
        self._done.set()
        for thread in self._threads:
            thread.join(self._config.timeout_s + 1.0)
        self._commands.close()

    def _poll(self, name: str, path: str, period_s: float, limit: int) -> None:
        """Read one sensor for ever, each time a period after the last began."""
        connection = Connection(self._config.address, self._config.timeout_s)
        due_s = time.monotonic()
        while not self._done.wait(max(due_s - time.monotonic(), 0.0)):
            began_s = time.monotonic()
            due_s = max(due_s + period_s, began_s)
            try:
                status, body = connection.call("GET", path, None, limit, whole=True)
            except (OSError, http.client.HTTPException, ValueError) as error:
                self.refuse(name, _reason(error), heard=False)
            else:
                self._answered.set()
                self.take(name, status, body if len(body) <= limit else None, began_s)
        connection.close()

    def take(self, name: str, status: int, body: bytes | None, began_s: float) -> None:
        """Take one answer (None: it was too large) to a request that began at `began_s`."""
        try:
            if status != HTTPStatus.OK:
                raise BadMessage(f"status {status}")
            if body is None:
                raise BadMessage("too large")
            getattr(self, f"_take_{name}")(body, began_s)
        except BadMessage as error:
            self.refuse(name, str(error))
        except Exception as error:  # one odd answer must not end all reading
            log.exception("%s: could not be read", name)
            self.refuse(name, type(error).__name__)

    def _take_camera(self, body: bytes, began_s: float) -> None:
        picture, here = decoded(body), self.odometry.get()
        if not self._pictures.new(picture, here.value if here else None, began_s):
            raise BadMessage("the same picture although the robot moved")
        facts = f"{picture.shape[1]}x{picture.shape[0]} jpeg"
        self.camera.put(preprocess(picture), began_s, facts)

    def _take_odometry(self, body: bytes, began_s: float) -> None:
        """Odometry with the sequence number of the last one is no new reading."""
        pose, sequence = replies.odometry(body)
        if sequence != self._sequence:
            self._sequence = sequence
            self.odometry.put(pose, began_s)

    def _take_bumper(self, body: bytes, began_s: float) -> None:
        self.bumper.put(replies.bumper(body), began_s)

    def _take_battery(self, body: bytes, began_s: float) -> None:
        self.battery.put(replies.battery(body), began_s)

    def _fault(self, reason: str) -> RobotFault:
        self.count("command", reason)
        return RobotFault(f"command: {reason}")


def _reason(error: Exception) -> str:
    if isinstance(error, TimeoutError):
        return "timeout"
    return "no connection" if isinstance(error, OSError) else "broken answer"
