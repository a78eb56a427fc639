"""Recovery after a bump (E11): by real motion, within its limits, clear of walls afterwards."""

import math
from collections.abc import Iterator

import numpy as np
import pytest

from services.robot_driver.recovery import back_off
from services.robot_driver.robot import STANDSTILL, Felt, Pose, Sensed, Velocity
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import load_world
from shared.config import RobotConfig

CONFIG = RobotConfig()
WORLD = load_world("plus")
RADIUS = CONFIG.radius_m


@pytest.fixture(scope="module")
def robot() -> Iterator[SimRobot]:
    robot = SimRobot(CONFIG, WORLD, 1)
    yield robot
    robot.close()


def place(robot: SimRobot, x: float, y: float, heading: float) -> None:
    robot.restore({**robot.state(), "x_m": x, "y_m": y, "heading_rad": heading})


def bump_into_the_boundary(robot: SimRobot) -> Pose:
    place(robot, 4.0, 0.0, 0.0)
    robot.drive(Velocity(CONFIG.speed_m_s, 0.0, 0.0))
    assert robot.run(3.0, stop_on_contact=True)
    return robot.pose


def gap(pose: Pose) -> float:
    return float(WORLD.clearance(np.array([[pose.x_m, pose.y_m]]))[0]) - RADIUS


def test_back_off_retreats_by_its_distance_and_turns_to_the_heading(robot: SimRobot):
    front = bump_into_the_boundary(robot)
    assert back_off(robot, CONFIG, -2.0) == pytest.approx(CONFIG.recovery_distance_m)
    assert robot.pose.x_m == pytest.approx(front.x_m - CONFIG.recovery_distance_m)
    assert robot.pose.heading_rad == pytest.approx(-2.0)
    assert robot.state()["forward_m_s"] == robot.state()["turn_rad_s"] == 0.0


def test_back_off_with_a_wall_behind_ends_clear_of_both_walls(robot: SimRobot):
    tall = CONFIG.model_copy(update={"recovery_distance_m": 1.0})
    place(robot, 2.7 + RADIUS + 0.2, 0.0, 0.0)  # the island 0.2 m behind
    assert back_off(robot, tall, 1.0) == pytest.approx(0.1, abs=0.01)
    assert not robot.contact
    assert gap(robot.pose) == pytest.approx(0.1, abs=0.01)


def test_back_off_from_a_glancing_contact_is_not_stopped_by_it(robot: SimRobot):
    place(robot, 4.9 - RADIUS - 0.0005, 0.0, math.pi / 2)  # pressed sideways, driving along
    assert robot.contact
    assert back_off(robot, CONFIG, 0.0) == pytest.approx(CONFIG.recovery_distance_m, abs=0.3)
    assert robot.pose.heading_rad == pytest.approx(0.0)


class Recorder:
    """A robot that only writes down what it is told; the bumper is pressed as given."""

    def __init__(self, contacts: list[bool]) -> None:
        self.contacts, self.velocities, self.durations = contacts, [STANDSTILL], [0.0]
        self.stopping: list[bool] = []

    def sense(self) -> Sensed:
        raise AssertionError("a recovery needs no picture")

    def feel(self) -> Felt:
        return Felt(Pose(0.0, 0.0, 0.0), self.contacts.pop(0))

    def drive(self, velocity: Velocity) -> None:
        self.velocities.append(velocity)

    def run(self, duration_s: float, *, stop_on_contact: bool) -> bool:
        self.durations.append(duration_s)
        self.stopping.append(stop_on_contact)
        return False


def test_back_off_keeps_to_its_speed_and_distance_whatever_the_bumper_says():
    for contacts in ([False] * 99, [True] * 99, [True, True, False] + [False] * 99):
        recorder = Recorder(list(contacts))
        back_off(recorder, CONFIG, 1.0)  # type: ignore[arg-type]
        speeds = [abs(v.forward_m_s) for v in recorder.velocities]
        assert max(speeds) <= CONFIG.recovery_speed_m_s
        assert max(abs(v.turn_rad_s) for v in recorder.velocities) <= CONFIG.turn_rad_s
        assert recorder.velocities[-1] == STANDSTILL
        straight = sum(recorder.durations[1:-1]) * CONFIG.recovery_speed_m_s
        assert straight <= CONFIG.recovery_distance_m + 1e-9


def test_a_retreat_with_a_free_bumper_stops_at_contact():
    recorder = Recorder([False] * 99)
    back_off(recorder, CONFIG, 1.0)  # type: ignore[arg-type]
    assert recorder.stopping == [True, False]  # the retreat, then the turn on the spot


def test_a_robot_whose_bumper_never_lets_go_creeps_nowhere_after_its_retreat():
    recorder = Recorder([True] * 99)
    back_off(recorder, CONFIG, 1.0)  # type: ignore[arg-type]
    assert all(velocity.forward_m_s <= 0.0 for velocity in recorder.velocities)
