"""`corridor router` as a process: where it listens, what it refuses, how it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from fakes import answering, message

from benchmarks.waiting import wait_until
from shared.bus import Bus
from shared.config import BusConfig
from shared.errors import PeerMissing
from shared.keys import ROBOT_WORLD
from shared.messages import WorldChange, WorldChanged

pytestmark = pytest.mark.system

ROUTER = [sys.executable, "-m", "services.cli", "router"]


@contextmanager
def running(*options: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A router process and its endpoint; killed at the end at the latest."""
    with subprocess.Popen(
        [*ROUTER, "--listen", "tcp/127.0.0.1:0", *options],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_prints_its_endpoint_and_ends_cleanly_on_signals(number: signal.Signals) -> None:
    with running() as (process, endpoint):
        Bus(BusConfig(endpoint=endpoint), "test").close()
        process.send_signal(number)
        assert process.wait(5) == 0


@pytest.mark.parametrize("attempt", range(6))
def test_ends_on_a_signal_that_came_while_it_was_frozen(attempt: int) -> None:
    """Any of its threads may get that signal."""
    with running() as (process, endpoint), Bus(BusConfig(endpoint=endpoint), "test"):
        process.send_signal(signal.SIGSTOP)
        process.send_signal(signal.SIGTERM)
        process.send_signal(signal.SIGCONT)
        assert process.wait(30) == 0


def test_ends_when_its_tether_is_cut() -> None:
    with running("--tethered") as (process, _):
        assert process.stdin is not None
        process.stdin.close()
        process.wait(5)


def test_refuses_a_port_in_use_with_one_line() -> None:
    with running() as (_, endpoint):
        second = subprocess.run(
            [*ROUTER, "--listen", endpoint], capture_output=True, text=True, timeout=30, check=False
        )
    assert second.returncode == 2
    assert second.stdout == ""
    assert second.stderr.count("\n") == 1
    assert f"router: cannot listen on '{endpoint}'" in second.stderr
    assert "Address already in use" in second.stderr


def test_routes_requests_between_clients(router: str, run_name: str) -> None:
    config = BusConfig(endpoint=router)
    told = message(WorldChanged, world="plus")
    with (
        answering(config, run_name, "r1", lambda _: told, ROBOT_WORLD),
        Bus(config, run_name) as client,
    ):

        def ask() -> WorldChanged | None:
            question = WorldChange(kind="list")
            try:
                return client.request(ROBOT_WORLD, question, WorldChanged, ident="r1")
            except PeerMissing:  # the declaration travels: not visible yet
                return None

        assert wait_until(ask, 5, "an answer through the router") == told


def test_status_without_a_router_is_one_line(tmp_path: Path) -> None:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("CORRIDOR_")}
    command = [sys.executable, "-m", "services.cli", "status", "--endpoint", "tcp/127.0.0.1:1"]
    result = subprocess.run(
        command, capture_output=True, text=True, cwd=tmp_path, env=environment, check=False
    )
    assert result.returncode == 1
    assert result.stderr.startswith("corridor: no Zenoh router at tcp/127.0.0.1:1")
    assert result.stderr.count("\n") == 1
