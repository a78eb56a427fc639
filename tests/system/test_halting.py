"""The emergency stop that `corridor up` gives, against stand-ins for robots and a real router."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from fakes import answering, message

from benchmarks.waiting import wait_until
from services.launcher.halting import stop_all
from services.launcher.watcher import Watcher
from shared.bus import Bus, open_router
from shared.config import BusConfig, Config, RunConfig
from shared.keys import ROBOT_COMMAND
from shared.messages import Message, RobotCommand, RobotState

pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]


@pytest.fixture
def config(router: str, run_name: str) -> Config:
    return Config(run=RunConfig(name=run_name), bus=BusConfig(endpoint=router))


@contextmanager
def robot(config: Config, name: str, heard: list[Message], state: str = "estop") -> Iterator[None]:
    """A driver that is visible and acknowledges commands with a state."""

    def answer(request: Message) -> Message:
        heard.append(request)
        return message(RobotState, robot=name, state=state)

    with answering(config.bus, config.run.name, ROBOT_COMMAND, name, answer) as bus:
        bus.announce("driver", name, "0" * 12, 1, config.fingerprint())
        yield


def visible(bus: Bus, count: int) -> None:
    wait_until(lambda: len(bus.peers()) == count, 20, f"{count} robots to be visible")


def test_every_robot_is_told_and_what_it_answers_is_shown(config: Config) -> None:
    heard: list[Message] = []
    with (
        robot(config, "alpha", heard),
        robot(config, "beta", heard, "driving"),
        Bus(config.bus, config.run.name) as mute,
        Bus(config.bus, config.run.name) as bus,
    ):
        mute.announce("driver", "gamma", "0" * 12, 1, config.fingerprint())
        mute.announce("actor", "main", "0" * 12, 1, config.fingerprint())
        visible(bus, 4)
        told = stop_all(bus)
    assert told.startswith(
        "emergency stop sent; robots: alpha stands, beta is driving, gamma does not answer (",
    )
    assert heard == [RobotCommand(command="estop")] * 2


def test_without_a_robot_or_a_router_it_says_that_nothing_was_sent(config: Config) -> None:
    with Bus(config.bus, config.run.name) as bus:
        assert stop_all(bus) == "emergency stop NOT sent: no robot answers"
    watcher = Watcher(config)  # it has not begun
    watcher.halt()
    assert watcher.told.endswith(" emergency stop NOT sent: no router answers")


def test_a_watcher_sees_a_router_come_and_go(run_name: str) -> None:
    with open_router("tcp/127.0.0.1:0") as endpoint:
        config = Config(run=RunConfig(name=run_name), bus=BusConfig(endpoint=endpoint))
        with Watcher(config) as watcher:
            wait_until(lambda: watcher.sight.connected, 20, "a connection")
            watcher.halt()
            assert watcher.told.endswith("no robot answers")
    with Watcher(config) as watcher:
        first = watcher.sight
        wait_until(lambda: watcher.sight is not first, 20, "a look")
        assert not watcher.sight.connected
