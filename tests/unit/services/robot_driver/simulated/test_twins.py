"""Twins: several robots in one scene, each with a state of its own."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from services.robot_driver.robot import Velocity
from services.robot_driver.simulated import sim
from services.robot_driver.simulated.scene import Scene
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import load_world
from services.robot_driver.simulated.world_parts import Obstacle
from shared.config import RobotConfig

CONFIG = RobotConfig()
PLUS = load_world("plus")
BOX = Obstacle(
    name="box", x_m=3.8, y_m=1.5, length_m=0.6, width_m=0.4, height_m=0.5, rgb=(220, 20, 20)
)
AHEAD = Velocity(0.3, 0.0, 0.0)


@pytest.fixture
def robot() -> Iterator[SimRobot]:
    robot = SimRobot(CONFIG, PLUS, 1)
    yield robot
    robot.close()


@pytest.fixture
def twin(robot: SimRobot) -> Iterator[SimRobot]:
    twin = robot.twin()
    yield twin
    twin.close()


def winding(robot: SimRobot) -> dict[str, float | int | str]:
    """The state of a robot that is about to complete a lap."""
    return {**robot.state(), "winding_rad": 2.0 * math.pi - 1e-3}


def test_a_twin_begins_in_the_same_state_without_another_scene(
    robot: SimRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sim, "Scene", None)
    robot.restore(winding(robot))
    robot.drive(AHEAD)
    twin = robot.twin()
    assert twin.state() == robot.state()
    assert np.array_equal(twin.frame(), robot.frame())
    twin.close()


def test_twins_drive_on_apart(robot: SimRobot) -> None:
    robot.restore(winding(robot))
    twin, state = robot.twin(), robot.state()
    twin.drive(AHEAD)
    twin.run(2.0, stop_on_contact=True)
    assert robot.state() == state
    assert (twin.laps.left, robot.laps.left) == (1, 0)
    robot.drive(AHEAD)
    robot.run(2.0, stop_on_contact=True)
    assert robot.state() == twin.state()
    twin.close()


def test_twins_are_no_obstacles(robot: SimRobot, twin: SimRobot) -> None:
    assert twin.pose == robot.pose
    assert not twin.contact
    picture = robot.frame()
    twin.drive(AHEAD)
    twin.run(1.0, stop_on_contact=True)
    assert np.array_equal(robot.frame(), picture)


def test_a_changed_world_is_no_longer_shared(robot: SimRobot, twin: SimRobot) -> None:
    before = robot.frame()
    twin.place(BOX)
    assert robot.obstacles == ()
    assert np.array_equal(robot.frame(), before)
    assert not np.array_equal(twin.frame(), before)
    twin.remove(BOX.name)
    assert np.array_equal(twin.frame(), before)
    robot.place(BOX)
    assert np.array_equal(twin.frame(), before)
    twin.switch(load_world("minus"))
    assert robot.world == PLUS
    assert robot.contact is twin.contact is False


def test_a_scene_lasts_until_its_last_robot_is_closed(robot: SimRobot) -> None:
    before, twin = robot.frame(), robot.twin()
    third = twin.twin()
    twin.close()
    twin.close()
    assert np.array_equal(robot.frame(), before)
    robot.close()
    assert np.array_equal(third.frame(), before)
    third.close()
    with pytest.raises(Exception, match="Not connected"):
        third.frame()


def test_a_closed_scene_is_not_shared() -> None:
    scene = Scene(PLUS, CONFIG.radius_m, CONFIG.camera)
    scene.close()
    with pytest.raises(ValueError, match="closed scene cannot be shared"):
        scene.shared()
