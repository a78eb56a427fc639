"""A Robotino's REST interface in front of an emulated base: `corridor emulate robotino`.

Beside the robot's own paths there are two for tests, which no fault reaches: `/emulator/faults`
(GET, POST) and `/emulator/truth` (GET).
"""

import json
import math
import signal
import socket
import struct
import threading
import time
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Annotated, Any, ClassVar, Literal
from urllib.parse import urlsplit

import cv2
import numpy as np
from pydantic import Field, TypeAdapter, ValidationError

from services.robot_driver.emulation.dynamics import ROBOTINO, STEP_S
from services.robot_driver.emulation.fault_set import FaultSet
from services.robot_driver.emulation.world import EmulatedRobot, camera_of
from services.robot_driver.robot import Velocity
from shared.config import RobotConfig
from shared.errors import ConfigError, first_problem

WIDTH, HEIGHT = 800, 600
QUALITY = 80
VERTICAL_FOV_DEG = 43.0
COLD_S = 10.0
"""Without a request for this long the camera is let go: the next one finds none."""
SILENT_S = 10.0
"""Longest that a request is left without an answer; then its connection is closed."""
MAX_BODY = 4096
Speed = Annotated[float, Field(strict=True, ge=-2.0, le=2.0, allow_inf_nan=False)]
Turn = Annotated[float, Field(strict=True, ge=-3.0, le=3.0, allow_inf_nan=False)]
_COMMAND = TypeAdapter(tuple[Speed, Speed, Turn])
"""`[vx, vy, omega]`; the server refuses commands beyond these."""
FREE_M = 0.41
"""What distance sensors tell with nothing near; these ones never see anything."""
Reply = tuple[int, str, bytes]
_EMPTY: Reply = (HTTPStatus.OK, "application/json", b"")


class Faults(FaultSet):
    """What is wrong with the robot or with the way to it. Frozen; the defaults are a sound one."""

    bumper: Literal["", "stuck", "unreadable", "nonsense"] = ""
    """stuck: pressed; unreadable: status 500; nonsense: an object without the value."""
    odometry: Literal["", "frozen", "stalled", "constant", "empty"] = ""
    """frozen: the same reading again and again; stalled: the motors do not turn, readings go on;
    constant: the same pose in new readings."""
    camera: Literal["", "frozen", "500", "truncated", "empty", "noiseless", "flat"] = ""
    """noiseless: equal pictures where it stands; flat: one grey alone."""
    stall_s: float = Field(default=0.0, ge=0.0, le=10.0)
    """Every answer comes so much later."""
    network: Literal["", "cut", "silent", "reset"] = ""
    """cut: connections are closed; silent: taken, never answered; reset: reset by the peer."""
    commands: Literal["", "refused"] = ""
    """refused: status 503 for velocities alone."""
    post_ignored: bool = False
    """As old images do: POST is answered and does nothing, PUT works."""
    watchdog_s: float = Field(default=ROBOTINO.watchdog_s, gt=0.0, le=5.0)
    """Time after which the base stops by itself: 0.2 s as documented, 0.5 s in older sources."""


class EmulatedRobotino:
    """The robot's paths, without a socket: a path in, status, type and body out."""

    def __init__(self, world: str, faults: Faults) -> None:
        shape = RobotConfig()
        camera = camera_of(VERTICAL_FOV_DEG, WIDTH / HEIGHT)
        self.robot = EmulatedRobot(world, ROBOTINO, shape.model_copy(update={"camera": camera}))
        self._lock = threading.Lock()
        self.faults = faults
        """What is wrong now."""
        self._last: dict[str, bytes] = {}
        """Answers that are repeated once they are frozen."""
        self._asked_s = -math.inf
        self.robot.configure(
            odometry=faults.odometry, watchdog_s=faults.watchdog_s, scale=faults.scale
        )

    def change(self, body: bytes) -> Faults:
        """Change faults by a JSON object. Raises ValueError."""
        with self._lock:
            self.faults = self.faults.changed(json.loads(body))
            now = self.faults
            self.robot.configure(odometry=now.odometry, watchdog_s=now.watchdog_s, scale=now.scale)
            return now

    def get(self, path: str) -> Reply:
        """Answer a GET."""
        faults = self.faults
        if path == "/cam0":
            return self._camera(faults)
        if path == "/data/bumper":
            return self._bumper(faults)
        if path == "/data/odometry":
            return self._odometry(faults)
        if path == "/data/powermanagement":
            self.robot.tell_battery(low=faults.battery_low)
            return _json(
                {
                    "batteryLow": faults.battery_low,
                    "batteryLowShutdownCounter": 60 if faults.battery_low else 0,
                    "batteryType": "Li-Ion",
                    "ext_power": False,
                    "num_chargers": 0,
                    "voltage": 15.9 if faults.battery_low else 19.2,
                }
            )
        if path == "/data/distancesensorarray":
            return _json([FREE_M] * 9)
        if path in {"/data/scan0", "/data/festoolcharger"}:
            return _EMPTY  # not fitted
        return HTTPStatus.NOT_FOUND, "text/plain", b"not found"

    def drive(self, method: str, body: bytes) -> Reply:
        """Answer a PUT or POST of a velocity."""
        faults = self.faults
        if faults.commands == "refused":
            return HTTPStatus.SERVICE_UNAVAILABLE, "text/plain", b"busy"
        try:
            velocity = Velocity(*_COMMAND.validate_json(body))
        except ValidationError as error:
            return HTTPStatus.BAD_REQUEST, "text/plain", first_problem(error).encode()
        if method == "PUT" or not faults.post_ignored:
            self.robot.command(velocity)
        return _EMPTY

    def _camera(self, faults: Faults) -> Reply:
        now_s = time.monotonic()
        with self._lock:
            cold = now_s - self._asked_s > COLD_S
            self._asked_s = now_s
        if cold or faults.camera == "500":
            return HTTPStatus.INTERNAL_SERVER_ERROR, "text/plain", b"No jpeg image available"
        if faults.camera == "empty":
            return HTTPStatus.OK, "image/jpeg", b""
        picture = self._last.get("camera") if faults.camera == "frozen" else None
        if picture is None:
            picture = jpeg(self.robot, faults.camera)
            self._last["camera"] = picture
        if faults.camera == "truncated":
            picture = picture[: len(picture) // 2]
        return HTTPStatus.OK, "image/jpeg", picture

    def _bumper(self, faults: Faults) -> Reply:
        if faults.bumper == "unreadable":
            return HTTPStatus.INTERNAL_SERVER_ERROR, "text/plain", b"no bumper"
        if faults.bumper == "nonsense":
            return _json({"values": 1})
        return _json({"value": faults.bumper == "stuck" or self.robot.counted().contact})

    def _odometry(self, faults: Faults) -> Reply:
        if faults.odometry == "empty":
            return _EMPTY
        body = self._last.get("odometry") if faults.odometry == "frozen" else None
        if body is None:
            now = self.robot.counted()
            values = (
                *(now.odometry.x_m, now.odometry.y_m, now.odometry.heading_rad),
                *(now.velocity.forward_m_s, now.velocity.left_m_s, now.velocity.turn_rad_s),
            )
            body = json.dumps([*(_shortest(value) for value in values), now.sequence]).encode()
            self._last["odometry"] = body
        return HTTPStatus.OK, "application/json", body


class Handler(BaseHTTPRequestHandler):
    """One connection, kept open as the robot's server does."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    wbufsize = -1
    """Buffered: a reply leaves in one piece."""
    timeout = 30.0
    robotino: ClassVar[EmulatedRobotino]

    def do_GET(self) -> None:
        """Readings, and what tests ask."""
        path = urlsplit(self.path).path
        if path == "/emulator/truth":
            self._reply(_json(self.robotino.robot.truth().tree()))
        elif path == "/emulator/faults":
            self._reply(_json(self.robotino.faults.model_dump()))
        elif self._reachable():
            self._reply(self.robotino.get(path))

    def log_message(self, format: str, *args: Any) -> None:
        """Keep quiet: forty requests a second."""

    def do_POST(self) -> None:
        """Commands, and changes of faults."""
        path = urlsplit(self.path).path
        length = self.headers.get("Content-Length", "0")
        size = int(length) if length.isdecimal() else MAX_BODY + 1
        if size > MAX_BODY:
            self.close_connection = True
            self._reply((HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "text/plain", b""))
            return
        body = self.rfile.read(size)
        if path == "/emulator/faults":
            self._reply(self._changed(body))
        elif self._reachable():
            if path == "/data/omnidrive":
                self._reply(self.robotino.drive(self.command, body))
            else:
                self._reply((HTTPStatus.NOT_FOUND, "text/plain", b"not found"))

    do_PUT = do_POST  # noqa: N815

    def _changed(self, body: bytes) -> Reply:
        try:
            return _json(self.robotino.change(body).model_dump())
        except (ValueError, RecursionError) as error:
            return HTTPStatus.BAD_REQUEST, "text/plain", str(error).encode()

    def _reachable(self) -> bool:
        """Whether the network lets this request through; waits where it is slow."""
        faults = self.robotino.faults
        if faults.stall_s:
            time.sleep(faults.stall_s)
        end_s = time.monotonic() + SILENT_S  # by then nobody waits any more
        while self.robotino.faults.network == "silent" and time.monotonic() < end_s:
            time.sleep(STEP_S)
        faults = self.robotino.faults if faults.network == "silent" else faults
        if not faults.network:
            return True
        self.close_connection = True
        if faults.network == "reset":
            linger = struct.pack("ii", 1, 0)
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
        return False

    def _reply(self, reply: Reply) -> None:
        status, kind, body = reply
        try:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)
        except OSError:  # the client did not wait for it
            self.close_connection = True


class RobotinoServer(ThreadingHTTPServer):
    """Listens for HTTP in front of an emulated Robotino; a context manager. Raises ConfigError."""

    daemon_threads = True
    block_on_close = False

    def __init__(self, listen: str, robotino: EmulatedRobotino) -> None:
        host, _, port = listen.rpartition(":")
        if not host or not port.isdecimal() or int(port) > 65535:
            raise ConfigError(f"--listen: expected host:port, got {listen!r}")
        handler = type("BoundHandler", (Handler,), {"robotino": robotino})
        try:
            super().__init__((host, int(port)), handler)
        except OSError as error:
            raise ConfigError(f"--listen: cannot listen on {listen!r}: {error}") from error

    @property
    def address(self) -> str:
        """host:port where it listens."""
        host, port = self.server_address[:2]
        return f"{host!s}:{port}"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A connection that broke is the client's business."""


def jpeg(robot: EmulatedRobot, fault: str = "") -> bytes:
    """The camera's picture as the robot's server sends it: rendered small, scaled up."""
    large = cv2.resize(robot.picture(fault), (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR)
    done, data = cv2.imencode(".jpg", large[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    assert done
    return np.asarray(data).tobytes()


def _shortest(value: float) -> float | int:
    """Whole numbers as integers, as the robot writes them."""
    return int(value) if value.is_integer() else value


def _json(tree: object) -> Reply:
    return HTTPStatus.OK, "application/json", json.dumps(tree).encode()


def run(world: str, listen: str, faults: Faults, ready: Any) -> None:
    """Be a Robotino until Ctrl-C or SIGTERM; `ready` is called with the address."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    robotino = EmulatedRobotino(world, faults)
    try:
        with RobotinoServer(listen, robotino) as server:
            ready(server.address)
            server.serve_forever(poll_interval=0.1)
    except KeyboardInterrupt:
        pass
    finally:
        robotino.robot.close()
