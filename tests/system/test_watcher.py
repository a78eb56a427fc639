"""The emergency stop that `corridor up` gives, against stand-ins for robots and a real router."""

from __future__ import annotations

import pytest
from fakes import fake_driver, message

from benchmarks.waiting import wait_until
from services.launcher.watcher import Watcher
from shared.bus import Bus, open_router
from shared.config import BusConfig, Config, RunConfig
from shared.keys import ROBOT_STATE
from shared.messages import RobotState

pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]


@pytest.fixture
def config(router: str, run_name: str) -> Config:
    return Config(run=RunConfig(name=run_name), bus=BusConfig(endpoint=router))


def test_every_robot_is_told_and_who_stands_is_shown(config: Config) -> None:
    with (
        fake_driver(config, "alpha") as alpha,
        fake_driver(config, "beta", refusals=2) as beta,
        Watcher(config) as watcher,
    ):
        wait_until(lambda: watcher.sight.connected, 20, "a connection")
        watcher.halt()
        told = watcher.told
        assert "emergency stop: sent; " in told
        for driver in (alpha, beta):
            assert f"{driver.name} (life {driver.life}): estop, stands" in told
        assert told.endswith("; all stand")
        with Bus(config.bus, config.run.name) as bus:
            bus.announce("actor", "alpha", "0" * 12, 2, "0" * 16)
            bus.publish(ROBOT_STATE, message(RobotState, robot="alpha"), "alpha")
            wait_until(lambda: watcher.sight.commanded == {"alpha"}, 20, "who commands alpha")


def test_without_a_robot_or_a_router_it_says_so(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shared.halts.orders.NOBODY_S", 0.3)
    watcher = Watcher(config)
    watcher.halt()  # it has not begun
    assert watcher.told.endswith(" emergency stop: NOT sent: no router answers")
    with watcher:
        wait_until(lambda: watcher.sight.connected, 20, "a connection")
        watcher.halt()
        assert "sent; no robot of run" in watcher.told


def test_a_watcher_sees_a_router_come_and_go(run_name: str) -> None:
    with open_router("tcp/127.0.0.1:0") as endpoint:
        config = Config(run=RunConfig(name=run_name), bus=BusConfig(endpoint=endpoint))
        with Watcher(config) as watcher:
            wait_until(lambda: watcher.sight.connected, 20, "a connection")
    with Watcher(config) as watcher:
        first = watcher.sight
        wait_until(lambda: watcher.sight is not first, 20, "a look")
        assert not watcher.sight.connected
