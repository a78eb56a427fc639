"""Commands to a Robotino whose server answers oddly: each is over in time."""

from __future__ import annotations

import http.client
import socket
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress

import cv2
import numpy as np
import pytest
from fake_link import config_of

from benchmarks.waiting import wait_until
from services.robot_driver.real.http_call import Connection
from services.robot_driver.real.robotino import RobotinoLink
from services.robot_driver.robot import STANDSTILL, RobotFault

pytestmark = pytest.mark.timeout(60)


@contextmanager
def server(head: bytes, piece: bytes) -> Iterator[str]:
    """Answers every request with `head`, then with `piece` again and again, without end."""
    done = threading.Event()
    threads: list[threading.Thread] = []

    def serve(connection: socket.socket) -> None:
        with connection, suppress(OSError):
            connection.recv(65536)
            connection.sendall(head)
            while piece and not done.wait(0.01):
                connection.sendall(piece)
            done.wait()

    def accept() -> None:
        with suppress(OSError):
            while True:
                threads.append(threading.Thread(target=serve, args=(listening.accept()[0],)))
                threads[-1].start()

    with socket.create_server(("127.0.0.1", 0)) as listening:
        acceptor = threading.Thread(target=accept)
        acceptor.start()
        try:
            yield f"127.0.0.1:{listening.getsockname()[1]}"
        finally:
            done.set()
            listening.shutdown(socket.SHUT_RDWR)
            acceptor.join()
            for thread in threads:
                thread.join()


def link_to(address: str, **hardware: float) -> RobotinoLink:
    slow = {"address": address, "timeout_s": 2.0}
    return RobotinoLink(config_of(robotino=slow, hardware={"command_period_s": 0.5, **hardware}))


@pytest.mark.parametrize("piece", [b"x", b"x" * 65536], ids=["trickle", "flood"])
def test_an_answer_that_does_not_end_holds_up_no_command(piece: bytes) -> None:
    head = b"HTTP/1.1 200 OK\r\nContent-Length: 1000000000\r\n\r\n"
    with server(head, piece) as address:
        link = link_to(address)
        for _ in range(3):
            link.send(STANDSTILL)
        link.close()
    assert not link.faults


def test_a_status_that_is_no_success_is_told() -> None:
    with server(b"HTTP/1.1 503 Busy\r\nContent-Length: 0\r\n\r\n", b"") as address:
        link = link_to(address)
        with pytest.raises(RobotFault, match="command: status 503"):
            link.send(STANDSTILL)
        link.close()


@pytest.mark.parametrize(
    ("head", "piece"), [(b"", b""), (b"HTTP/1.1 200 OK\r\nX-Slow: ", b"x")], ids=["none", "drips"]
)
def test_no_answer_is_a_timeout(head: bytes, piece: bytes) -> None:
    with server(head, piece) as address:
        link = link_to(address)
        with pytest.raises(RobotFault, match="command: timeout"):
            link.send(STANDSTILL)
        link.close()


@pytest.mark.parametrize(
    ("answer", "piece", "error"),
    [
        (b"HTTP/1.1 200 OK\r\nContent-Length: 10000\r\n\r\n", b"x", TimeoutError),
        (b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n", b"x", ValueError),
        (b"SSH-2.0\r\n", b"", http.client.HTTPException),
    ],
    ids=["drips", "broken", "no-http"],
)
def test_a_reading_needs_its_whole_answer_in_time(
    answer: bytes, piece: bytes, error: type[Exception]
) -> None:
    with server(answer, piece) as address:
        connection = Connection(address, 0.3)
        with pytest.raises((error, http.client.HTTPException)):
            connection.call("GET", "/cam0", None, 20_000, whole=True)
        assert connection.sock is None


def test_a_sensor_whose_answers_are_none_is_told_of_and_a_silent_robot_is_none() -> None:
    busy = b"HTTP/1.1 500 No camera connected\r\nContent-Length: 0\r\n\r\n"
    with server(busy, b"") as address, closing(link_to(address)) as link:
        link.open()
        wait_until(lambda: link.bumper.note, 20, "an answer")
        assert (link.bumper.get(), link.bumper.note) == (None, "status 500")
    with (
        server(b"", b"") as address,
        closing(link_to(address, open_timeout_s=0.5)) as link,
        pytest.raises(RobotFault, match=r"no answer from .* within"),
    ):
        link.open()


def test_what_cannot_be_read_is_not_what_was_read_before() -> None:
    """Nor is what was only repeated; a request that brings nothing leaves the reading to age."""
    link = link_to("127.0.0.1:9")
    link.take("bumper", 200, b'{"value": false}', 1.0)
    link.take("odometry", 200, b"[1, 2, 0, 0, 0, 0, 7]", 1.0)
    link.take("battery", 200, b'{"batteryLow": false}', 1.0)
    link.take("odometry", 200, b"[3, 4, 0, 0, 0, 0, 7]", 2.0)
    readings = [slot.get() for slot in (link.bumper, link.odometry, link.battery)]
    assert [reading and reading.stamp_s for reading in readings] == [1.0, 1.0, 1.0]
    for name in ("bumper", "odometry", "battery"):
        link.take(name, 200, b"garbage", 3.0)
    assert (link.bumper.get(), link.battery.get()) == (None, None)
    assert link.odometry.get() == readings[1]
    assert "not as expected" in link.odometry.note


def test_a_frozen_camera_is_found_out_when_the_robot_moves() -> None:
    link = link_to("127.0.0.1:9")
    done, data = cv2.imencode(".jpg", np.full((60, 80, 3), 128, np.uint8))
    assert done
    for at_s, x_m, taken in ((0.0, 0.0, 1), (0.1, 0.0, 2), (0.2, 0.1, 2), (3.0, 0.1, 3)):
        link.take("odometry", 200, f"[{x_m}, 0, 0, 0, 0, 0, {int(10 * at_s)}]".encode(), at_s)
        link.take("camera", 200, data.tobytes(), at_s)
        reading = link.camera.get()
        assert reading is not None
        assert reading.number == taken
    assert link.faults["camera: the same picture although the robot moved"] == 1
