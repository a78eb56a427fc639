"""While the robot recovers, limits and operators count as they do while it drives."""

from __future__ import annotations

import pytest

from services.robot_driver.host import Host
from services.robot_driver.recovery import Halted, WatchedRobot, back_off
from services.robot_driver.robot import STANDSTILL, Felt, Pose, Robot, Sensed, Velocity
from services.robot_driver.safety import Safety
from shared.config import RobotConfig


class FreeRobot(Robot):
    """Moves straight along x, without walls; remembers what it was told."""

    def __init__(self) -> None:
        self.velocity = STANDSTILL
        self.told: list[Velocity] = []
        self.x_m = self.time_s = 0.0

    def sense(self) -> Sensed:
        raise AssertionError("a recovery needs no picture")

    def feel(self) -> Felt:
        return Felt(Pose(self.x_m, 0.0, 0.0), contact=False)

    def drive(self, velocity: Velocity) -> None:
        self.velocity = velocity
        self.told.append(velocity)

    def run(self, duration_s: float, *, stop_on_contact: bool) -> bool:
        self.x_m += self.velocity.forward_m_s * duration_s
        self.time_s += duration_s
        return False

    def now_s(self) -> float:
        return self.time_s

    def state(self) -> dict[str, float | int | str]:
        return {}

    def restore(self, state: dict[str, float | int | str]) -> None:
        pass

    def close(self) -> None:
        pass


def test_estop_during_recovery_ends_it_within_one_slice_standing_still() -> None:
    robot, safety, looks = FreeRobot(), Safety(RobotConfig()), 0

    class Operator(Host):
        def look(self) -> None:
            nonlocal looks
            looks += 1
            safety.estop = looks == 5

    with pytest.raises(Halted):
        back_off(WatchedRobot(robot, safety, Operator(), 0.02), RobotConfig(), 1.0)
    assert robot.time_s == pytest.approx(5 * 0.02)
    assert robot.velocity == STANDSTILL
    assert -0.03 < robot.x_m < 0.0


def test_slices_add_up_to_the_whole_motion() -> None:
    config = RobotConfig()
    whole, sliced = FreeRobot(), FreeRobot()
    for robot, slice_s in ((whole, None), (sliced, 0.02)):
        back_off(WatchedRobot(robot, Safety(config), Host(), slice_s), config, 1.0)
    assert sliced.x_m == pytest.approx(whole.x_m)
    assert whole.x_m == pytest.approx(-config.recovery_distance_m)
    assert sliced.time_s == pytest.approx(whole.time_s)


def test_recovery_cannot_exceed_the_limits() -> None:
    config = RobotConfig()
    robot, safety = FreeRobot(), Safety(config)
    WatchedRobot(robot, safety, Host(), None).drive(Velocity(-9.0, 0.0, 9.0))
    assert robot.velocity == Velocity(-config.max_speed_m_s, 0.0, config.max_turn_rad_s)
    assert safety.clamped == 1
