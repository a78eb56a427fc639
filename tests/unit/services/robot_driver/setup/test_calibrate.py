"""What a robot makes of its commands is found from its odometry, in simulated time."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from fake_link import FakeLink, Plane, config_of

from services.robot_driver.emulation.dynamics import (
    CREATE3,
    ROBOTINO,
    STEP_S,
    BaseDynamics,
    EmulatedBase,
)
from services.robot_driver.robot import STANDSTILL, Felt, NotReady, Robot, Sensed, Velocity
from services.robot_driver.setup.calibrate import calibrate
from services.robot_driver.setup.response import response
from shared.config import CalibrationConfig, Config
from shared.errors import ConfigError, RobotMissing

CONFIG = config_of(period_s=0.2, deadman_s=0.3, speed_m_s=0.2, turn_rad_s=0.6, max_turn_rad_s=1.0)
EVERY = 5
"""Steps between two readings of the odometry."""


class SimulatedRobot(Robot):
    """A base in simulated time, with a link that tells its odometry ten times a second."""

    def __init__(self, dynamics: BaseDynamics) -> None:
        self.base = EmulatedBase(Plane(), dynamics, 0.0)
        self.link = FakeLink()
        self.wanted = STANDSTILL
        self.unfit, self.touches, self.steps = "", False, 0
        self.left_scale = 1.0
        """Part of its turn rate that it makes to the left."""

    def sense(self) -> Sensed:
        raise AssertionError("nobody looks")

    def feel(self) -> Felt:
        if self.unfit:
            raise NotReady(self.unfit)
        return Felt(self.base.odometry, False)

    def drive(self, velocity: Velocity) -> None:
        left = self.left_scale if velocity.turn_rad_s > 0.0 else 1.0
        self.wanted = replace(velocity, turn_rad_s=left * velocity.turn_rad_s)

    def run(self, duration_s: float, *, stop_on_contact: bool) -> bool:
        for _ in range(max(1, round(duration_s / STEP_S))):
            if self.steps % EVERY == 0:
                self.base.command(self.wanted, self.base.now_s)
                self.link.odometry.put(self.base.odometry, self.base.now_s)
            self.steps += 1
            self.base.step(STEP_S)
        return self.touches and self.wanted.moving

    def now_s(self) -> float:
        return self.base.now_s

    def state(self) -> dict[str, float | int | str]:
        return {}

    def restore(self, state: dict[str, float | int | str]) -> None:
        assert not state

    def close(self) -> None:
        pass

    @property
    def faults(self) -> Counter[str]:
        return Counter()


def measured(robot: SimulatedRobot, config: Config = CONFIG) -> CalibrationConfig:
    return calibrate(config, robot, robot.link, 0.6, "test", lambda _: None)


@pytest.mark.parametrize("dynamics", [ROBOTINO, CREATE3], ids=["robotino", "create3"])
@pytest.mark.parametrize("scale", [0.75, 1.0, 1.25])
def test_speed_turn_and_delay_are_found(dynamics: BaseDynamics, scale: float) -> None:
    found = measured(SimulatedRobot(replace(dynamics, scale=scale)))
    assert found.speed_m_s == pytest.approx(scale * 0.2, rel=0.03)
    assert found.turn_rad_s == pytest.approx(scale * 0.6, rel=0.03)
    assert abs(found.delay_s - dynamics.delay_s) < CONFIG.robot.period_s


def test_the_scale_of_rewards_follows() -> None:
    found = CalibrationConfig(speed_m_s=0.15, turn_rad_s=0.45)
    robot = CONFIG.robot.model_copy(update={"calibration": found})
    config = CONFIG.model_copy(update={"robot": robot})
    assert config.max_distance_m == pytest.approx(0.75 * CONFIG.max_distance_m)
    assert config.fingerprint() != CONFIG.fingerprint()


def test_a_robot_that_touches_something_stands_and_nothing_is_found() -> None:
    robot = SimulatedRobot(ROBOTINO)
    robot.touches = True
    with pytest.raises(ConfigError, match="needs more room"):
        measured(robot)
    assert robot.wanted == STANDSTILL


def test_measurements_that_disagree_are_refused() -> None:
    robot = SimulatedRobot(ROBOTINO)
    robot.left_scale = 0.7
    with pytest.raises(ConfigError, match=r"to the left and to the right disagree: 0\.42\d and"):
        measured(robot)


@pytest.mark.parametrize(("stalled", "why"), [(True, "did not move"), (False, "no reading")])
def test_a_robot_that_does_not_follow_is_refused(stalled: bool, why: str) -> None:
    robot = SimulatedRobot(ROBOTINO)
    robot.base.stalled = stalled
    robot.unfit = "" if stalled else "camera: no reading"
    with pytest.raises((ConfigError, RobotMissing), match=why):
        measured(robot)


@pytest.mark.parametrize(
    ("way", "why"),
    [
        (lambda t: 0.2 * np.minimum(t, 2.2), "no steady speed"),
        (lambda t: -0.2 * t, "or the other way"),
        (lambda t: 0.0 * t, "did not move"),
    ],
)
def test_what_is_no_steady_drive_is_refused(way: Any, why: str) -> None:
    times_s = np.arange(0.0, 3.0, 0.1)
    with pytest.raises(ValueError, match=why):
        response(times_s, way(times_s), 3.0)


def test_few_readings_are_refused_and_noise_is_borne() -> None:
    times_s = np.arange(0.0, 3.0, 0.5)
    with pytest.raises(ValueError, match="only 2 readings"):
        response(times_s, 0.2 * times_s, 3.0)
    times_s = np.arange(0.0, 3.0, 0.1)
    noise = 0.002 * np.sin(37.0 * np.arange(len(times_s)))
    way = 0.2 * np.clip(times_s - 0.3, 0.0, None) + noise
    found = response(times_s, way, 3.0)
    assert found.speed == pytest.approx(0.2, rel=0.03)
    assert found.delay_s == pytest.approx(0.3, abs=0.1)
    assert math.isfinite(found.delay_s)
