"""Obstacles that come and go, and other worlds: solid, seen, counted anew, restored bit for bit."""

import hashlib
import json
import math
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.robot_driver.robot import Pose, Velocity
from services.robot_driver.simulated.sim import GAP_M, SKIN_M, SimRobot
from services.robot_driver.simulated.world import MAX_OBSTACLES, World, load_world
from services.robot_driver.simulated.world_parts import Obstacle
from shared.config import RobotConfig

CONFIG = RobotConfig()
PLUS = load_world("plus")
ROOM = World.model_validate(
    {
        **PLUS.model_dump(),
        "name": "room",
        "walls": PLUS.model_dump()["walls"][:1],
        "fixtures": (),
        "lap": None,
        "obstacles": (
            {
                "name": "table",
                "x_m": 0.0,
                "y_m": 0.0,
                "heading_deg": 45.0,
                "length_m": 1.0,
                "width_m": 0.5,
                "height_m": 0.7,
                "rgb": (120, 80, 40),
            },
        ),
    }
)


def box(name: str = "box", x: float = 3.8, y: float = 1.5, **given: Any) -> Obstacle:
    """A red box, on the way of a robot that starts in Plus."""
    plain: dict[str, Any] = {
        "name": name,
        "x_m": x,
        "y_m": y,
        "length_m": 0.6,
        "width_m": 0.4,
        "height_m": 0.5,
        "rgb": (220, 20, 20),
    }
    return Obstacle(**{**plain, **given})


@pytest.fixture
def robot() -> Iterator[SimRobot]:
    robot = SimRobot(CONFIG, PLUS, 1)
    yield robot
    robot.close()


def gap(pose: Pose, obstacle: Obstacle) -> float:
    """From the shell to a box, by plane geometry in the box's own axes."""
    turn = math.radians(obstacle.heading_deg)
    dx, dy = pose.x_m - obstacle.x_m, pose.y_m - obstacle.y_m
    along = abs(dx * math.cos(turn) + dy * math.sin(turn)) - obstacle.length_m / 2
    across = abs(dy * math.cos(turn) - dx * math.sin(turn)) - obstacle.width_m / 2
    outside = math.hypot(max(along, 0.0), max(across, 0.0))
    return outside + min(max(along, across), 0.0) - CONFIG.radius_m


def red(picture: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    channels = picture.astype(int)
    return (channels[:, :, 0] > 90) & (channels[:, :, 0] > 3 * channels[:, :, 1])


def test_a_box_on_the_way_stops_the_robot_and_presses_its_bumper(robot: SimRobot) -> None:
    robot.place(box())
    robot.drive(Velocity(0.6, 0.0, 0.0))
    assert robot.run(5.0, stop_on_contact=True)
    assert robot.contact
    assert GAP_M - 1e-5 < gap(robot.pose, box()) <= SKIN_M + 1e-5
    robot.remove("box")
    assert not robot.contact
    robot.drive(Velocity(0.6, 0.0, 0.0))
    assert not robot.run(1.0, stop_on_contact=True)
    assert robot.pose.y_m > box().y_m


@given(
    heading=st.floats(-360.0, 360.0),
    length=st.floats(0.05, 1.0),
    width=st.floats(0.05, 1.0),
    height=st.floats(0.05, 2.6),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=15, deadline=None)
def test_random_driving_never_gets_into_a_box(
    heading: float, length: float, width: float, height: float, seed: int
) -> None:
    obstacle = box(heading_deg=heading, length_m=length, width_m=width, height_m=height)
    robot, draw = SimRobot(CONFIG, PLUS, 1), np.random.default_rng(seed)
    try:
        robot.place(obstacle)
        touched = 0
        for _ in range(60):
            aim = math.atan2(1.5 - robot.pose.y_m, 3.8 - robot.pose.x_m) - robot.pose.heading_rad
            aim += float(draw.uniform(-1.0, 1.0))
            robot.drive(Velocity(0.8 * math.cos(aim), 0.8 * math.sin(aim), 1.0))
            touched += robot.run(float(draw.uniform(0.1, 0.6)), stop_on_contact=False)
            assert gap(robot.pose, obstacle) > GAP_M - 1e-5
        assert touched
    finally:
        robot.close()


def test_a_box_is_seen_from_all_sides_and_from_above(robot: SimRobot) -> None:
    bare = robot.frame(150, 100)
    robot.place(box())
    for heading in (0.0, math.pi / 2, math.pi, -math.pi / 2):
        x, y = 3.8 - 0.9 * math.cos(heading), 1.5 - 0.9 * math.sin(heading)
        seen = red(robot.look_from(Pose(x, y, heading), 150, 100))
        assert seen[40:60, 65:85].all(), heading
    # A box lower than the camera shows its top, and what is behind stays visible above it.
    robot.remove("box")
    robot.place(box(height_m=0.1))
    seen = red(robot.frame(150, 100))
    assert seen.any()
    assert not seen[:50].any()
    top = robot.frame(150, 100)[seen].max(axis=0)
    assert tuple(top) == (220, 20, 20)  # unlike sides it is not shaded
    robot.remove("box")
    assert np.array_equal(robot.frame(150, 100), bare)


def test_the_network_sees_another_image_with_a_box(robot: SimRobot) -> None:
    before = robot.sense().image
    robot.place(box())
    assert np.count_nonzero(before != robot.sense().image) > 100


def test_order_and_past_of_boxes_do_not_change_the_picture(robot: SimRobot) -> None:
    boxes = [box("a", y=1.5), box("b", y=1.9), box("c", x=3.2, y=2.4)]
    for obstacle in boxes:
        robot.place(obstacle)
    first = robot.frame(150, 100)
    for name in ("a", "c", "b"):
        robot.remove(name)
    for obstacle in (boxes[2], boxes[0], boxes[1]):
        robot.place(obstacle)
    assert np.array_equal(robot.frame(150, 100), first)


@pytest.mark.parametrize(
    ("obstacle", "message"),
    [
        (box("there"), "there is already an obstacle 'there'"),
        (box(y=0.0), "obstacle 'box' would overlap the robot"),
        (box(y=0.2 + CONFIG.radius_m), "obstacle 'box' would overlap the robot"),
        (box(x=4.8), "obstacle 'box': expected x"),
        (box(height_m=2.7), "is higher than the walls"),
    ],
)
def test_boxes_that_cannot_be_placed_are_refused_and_change_nothing(
    robot: SimRobot, obstacle: Obstacle, message: str
) -> None:
    robot.place(box("there", y=-1.5))
    state, picture = robot.state(), robot.frame()
    with pytest.raises(ValueError, match=message):
        robot.place(obstacle)
    assert robot.state() == state
    assert np.array_equal(robot.frame(), picture)


def test_a_box_may_stand_right_beside_the_robot(robot: SimRobot) -> None:
    robot.place(box(y=0.2 + CONFIG.radius_m + 2 * SKIN_M))
    assert not robot.contact


def test_there_is_a_bound_of_boxes(robot: SimRobot) -> None:
    many = tuple(box(f"box{i}", y=3.0) for i in range(MAX_OBSTACLES))
    robot.restore({**robot.state(), "obstacles": json.dumps([b.model_dump() for b in many])})
    with pytest.raises(ValueError, match=f"there are {MAX_OBSTACLES} obstacles already"):
        robot.place(box())


def test_unknown_names_cannot_be_removed(robot: SimRobot) -> None:
    robot.place(box())
    with pytest.raises(ValueError, match="there is no obstacle 'bax'"):
        robot.remove("bax")
    assert [obstacle.name for obstacle in robot.obstacles] == ["box"]


def test_a_switch_leads_to_a_start_of_the_other_world_with_its_obstacles(robot: SimRobot) -> None:
    robot.drive(Velocity(0.5, 0.0, 0.5))
    robot.run(1.0, stop_on_contact=True)
    robot.place(box())
    robot.switch(ROOM, 2)
    assert robot.world == ROOM
    assert robot.obstacles == ROOM.obstacles
    assert robot.pose == Pose(-3.8, 0.0, pytest.approx(-math.pi / 2))
    before = robot.pose
    robot.run(1.0, stop_on_contact=True)
    assert robot.pose == before  # it stood still
    robot.drive(Velocity(0.0, 1.0, 0.0))  # east, where Plus has its island
    assert robot.run(9.0, stop_on_contact=True)
    assert gap(robot.pose, ROOM.obstacles[0]) == pytest.approx(0.0, abs=0.002)
    robot.switch(PLUS)
    assert robot.obstacles == ()


@pytest.mark.parametrize("start", [-1, 3])
def test_a_start_that_does_not_exist_is_refused(robot: SimRobot, start: int) -> None:
    state = robot.state()
    with pytest.raises(ValueError, match=f"expected a start from 0 to 2, got {start}"):
        robot.switch(ROOM, start)
    assert robot.state() == state


def test_a_start_that_an_obstacle_touches_is_refused(robot: SimRobot) -> None:
    tree = ROOM.model_dump()
    tree["obstacles"] = [box("near", x=3.8, y=0.4).model_dump()]
    state = robot.state()
    with pytest.raises(ValueError, match=r"starts\.0 touches a wall or an obstacle"):
        robot.switch(World.model_validate(tree))
    assert robot.state() == state


def test_laps_begin_anew_in_the_other_world_and_counts_go_on(robot: SimRobot) -> None:
    state = {**robot.state(), "winding_rad": 6.2, "laps_left": 3, "laps_right": 1}
    robot.restore(state)
    robot.switch(PLUS)
    robot.drive(Velocity(0.5, 0.0, 0.0))
    robot.run(1.0, stop_on_contact=True)
    assert robot.laps == (2, 3, 1)
    robot.restore(state)
    robot.drive(Velocity(0.5, 0.0, 0.0))
    robot.run(1.0, stop_on_contact=True)
    assert robot.laps == (3, 4, 1)  # without the switch it would have been a lap


CONTINUE = """
import hashlib, json, sys
from services.robot_driver.simulated.sim import SimRobot
import tests.unit.services.robot_driver.simulated.test_simulated_world_changes as here
CONFIG, PLUS, ROOM, wander = here.CONFIG, here.PLUS, here.ROOM, here.wander
robot = SimRobot(CONFIG, ROOM if sys.argv[2] == "room" else PLUS, 1)
robot.restore(json.loads(sys.argv[1]))
wander(robot, 2)
image = hashlib.sha256(robot.frame(150, 100).tobytes()).hexdigest()
sys.stdout.write(json.dumps([robot.state(), image]))
"""


def wander(robot: SimRobot, seed: int) -> None:
    draw = np.random.default_rng(seed)
    for _ in range(60):
        robot.drive(Velocity(*map(float, draw.uniform(-1, 1, 3) * [0.8, 0.8, 2.0])))
        robot.run(0.25, stop_on_contact=True)


@pytest.mark.parametrize("name", ["plus", "room"])
def test_restored_in_another_process_it_continues_bit_for_bit(robot: SimRobot, name: str) -> None:
    robot.place(box("gone", y=2.0))
    robot.place(box(x=3.3, y=0.9, heading_deg=17.3))
    robot.place(box("wall", x=4.7, y=-1.0, length_m=0.4))  # flush with a wall
    robot.remove("gone")
    if name == "room":
        robot.switch(ROOM, 1)
        robot.place(box("second", y=-1.2))
    wander(robot, 1)
    saved = json.dumps(robot.state())
    wander(robot, 2)
    image = hashlib.sha256(robot.frame(150, 100).tobytes()).hexdigest()
    command = [sys.executable, "-c", CONTINUE, saved, name]
    other = subprocess.run(command, capture_output=True, check=True, text=True)
    assert json.loads(other.stdout) == [robot.state(), image]


def test_a_robot_of_another_world_is_restored_into_the_saved_one(robot: SimRobot) -> None:
    other = SimRobot(CONFIG, ROOM, 1)
    try:
        other.restore(robot.state())
        assert (other.world, other.obstacles, other.state()) == (PLUS, (), robot.state())
        assert np.array_equal(other.frame(), robot.frame())
    finally:
        other.close()
