"""Commands to a Robotino whose server answers oddly: each is over in time."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import pytest
from fake_link import config_of

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


def link_to(address: str) -> RobotinoLink:
    slow = {"address": address, "timeout_s": 2.0}
    return RobotinoLink(config_of(robotino=slow, hardware={"command_period_s": 0.5}))


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


def test_no_answer_is_a_timeout() -> None:
    with server(b"", b"") as address:
        link = link_to(address)
        with pytest.raises(RobotFault, match="command: timeout"):
            link.send(STANDSTILL)
        link.close()
