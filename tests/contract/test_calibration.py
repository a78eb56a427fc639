"""`corridor robot check` and `calibrate` in front of every emulator, which drives by the clock."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest
from robots import BRIDGE, RMW_ZENOH, fit, press, real_time, robotino_server, ros2_emulator

from benchmarks.waiting import wait_until
from services.robot_driver.emulation.dynamics import CREATE3, ROBOTINO
from services.robot_driver.emulation.robotino import Faults
from services.robot_driver.emulation.ros2_faults import Ros2Faults
from services.robot_driver.kinds import make_link
from services.robot_driver.real.hardware import HardwareRobot
from services.robot_driver.setup.calibrate import calibrate
from services.robot_driver.setup.check import check
from shared.config import Config

PERIOD_S = 0.3
"""The delay must be found within one of them."""


@contextmanager
def emulated(kind: str) -> Iterator[tuple[Config, float, float, object]]:
    """Its configuration, the true scale of its speeds, its delay, and the emulator."""
    if kind == "robotino":
        with robotino_server(Faults(scale=0.75)) as (_, address):
            yield config_of(kind, robotino={"address": address}), 0.75, ROBOTINO.delay_s, None
        return
    ros2 = RMW_ZENOH if kind == "ros2-rmw-zenoh" else BRIDGE
    dynamics = CREATE3 if kind == "ros2-rmw-zenoh" else ROBOTINO
    with ros2_emulator(Ros2Faults(scale=1.25, watchdog_s=5.0), **ros2) as robot:
        there = {**ros2, "endpoint": robot.endpoint}
        yield config_of("ros2", ros2=there), 1.25, dynamics.delay_s, robot


def config_of(kind: str, **robot: object) -> Config:
    return real_time(kind=kind, period_s=PERIOD_S, deadman_s=2.0, **robot)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["robotino", "ros2-bridge", "ros2-rmw-zenoh"])
def test_speed_turn_and_delay_are_found(kind: str) -> None:
    with emulated(kind) as (config, scale, delay_s, emulator):
        link = make_link(config)
        with closing(HardwareRobot(config.robot, link)) as robot:
            if config.robot.ros2.bumper_on_change:
                press(emulator, robot)  # type: ignore[arg-type]
            wait_until(lambda: fit(robot), 60, "it is ready")
            found = calibrate(config, robot, link, 0.6, "test", lambda _: None)
    assert found.speed_m_s == pytest.approx(scale * config.robot.speed_m_s, rel=0.03)
    assert found.turn_rad_s == pytest.approx(scale * config.robot.turn_rad_s, rel=0.03)
    assert abs(found.delay_s - delay_s) < PERIOD_S


@pytest.mark.parametrize("kind", ["robotino", "ros2-bridge"])
def test_a_robot_is_looked_at_and_moves_nothing(kind: str) -> None:
    lines: list[str] = []
    with emulated(kind) as (config, *_):
        assert check(config.robot, make_link(config), 2.0, lines.append) == []
    assert [line.split()[0] for line in lines[1:5]] == ["camera", "odometry", "bumper", "battery"]
    assert "grey values" in lines[1]
