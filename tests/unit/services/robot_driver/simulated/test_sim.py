"""The simulated robot: never through walls, contact anywhere, restorable, laps."""

import hashlib
import json
import math
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.robot_driver.recovery import back_off
from services.robot_driver.robot import Pose, Robot, Velocity
from services.robot_driver.simulated.kinematics import advance, wrap
from services.robot_driver.simulated.sim import GAP_M, SKIN_M, SimRobot
from services.robot_driver.simulated.world import World, load_world
from shared.config import RobotConfig

CONFIG = RobotConfig()
WORLD = load_world("plus")
RADIUS = CONFIG.radius_m
ACTIONS = [Velocity(CONFIG.speed_m_s, 0.0, turn * CONFIG.turn_rad_s) for turn in (0.0, 1.0, -1.0)]


@pytest.fixture(scope="module")
def shared() -> Iterator[SimRobot]:
    """One simulation for all: `fresh` puts it back to its first state."""
    robot = SimRobot(CONFIG, WORLD, 1)
    yield robot
    robot.close()


@pytest.fixture
def robot(shared: SimRobot) -> SimRobot:
    return fresh(shared)


def fresh(robot: SimRobot) -> SimRobot:
    start = WORLD.starts[0]
    place(robot, start.x_m, start.y_m, math.radians(start.heading_deg))
    return robot


def place(robot: SimRobot, x: float, y: float, heading: float) -> None:
    zero = dict.fromkeys(robot.state(), 0)
    names = {"world": WORLD.name, "world_fingerprint": WORLD.fingerprint, "obstacles": "[]"}
    robot.restore({**zero, **names, "x_m": x, "y_m": y, "heading_rad": heading})


def gap(pose: Pose) -> float:
    """To the nearest wall, by plane geometry instead of the physics engine."""
    return float(WORLD.clearance(np.array([[pose.x_m, pose.y_m]]))[0]) - RADIUS


def act(robot: SimRobot, action: int) -> bool:
    robot.drive(ACTIONS[action])
    return robot.run(CONFIG.period_s, stop_on_contact=True)


def test_it_is_a_robot(robot: SimRobot):
    checked: Robot = robot
    sensed = checked.sense()
    assert sensed.image.shape == (50, 75)
    assert sensed.image.dtype == np.uint8
    assert sensed.image.std() > 10  # not a blank wall of one grey
    assert sensed.pose == Pose(3.8, 0.0, math.pi / 2)
    assert not sensed.contact


@given(
    seed=st.integers(0, 2**32 - 1),
    actions=st.integers(1, 120),
    stop=st.booleans(),
    recover=st.booleans(),
)
@settings(max_examples=25, deadline=None)
def test_random_driving_and_recovery_never_leave_the_corridor(
    shared: SimRobot, seed: int, actions: int, stop: bool, recover: bool
):
    robot, draw = fresh(shared), np.random.default_rng(seed)
    for _ in range(actions):
        before = robot.pose
        speeds = draw.uniform(-1, 1, 3) * [0.8, 0.8, 3.0]
        fast = Velocity(*map(float, speeds)) if draw.random() < 0.3 else ACTIONS[draw.integers(3)]
        robot.drive(fast)
        period = float(draw.uniform(0.05, 0.6))
        bumped = robot.run(period, stop_on_contact=stop)
        assert gap(robot.pose) > GAP_M - 1e-5
        moved = math.dist((before.x_m, before.y_m), (robot.pose.x_m, robot.pose.y_m))
        assert moved <= math.hypot(fast.forward_m_s, fast.left_m_s) * period + 1e-9
        if bumped and recover:
            back_off(robot, CONFIG, float(draw.uniform(-math.pi, math.pi)))
            assert gap(robot.pose) > GAP_M - 1e-5


@pytest.mark.parametrize("angle", np.linspace(-math.pi, math.pi, 24, endpoint=False).tolist())
def test_contact_is_felt_anywhere_on_the_ring(robot: SimRobot, angle: float):
    """Whatever side of the robot leads towards the wall, it stops there, pressed, and reports."""
    wall = 0.0  # the boundary in the east, heading of its outward normal
    place(robot, 4.4, 0.0, wrap(wall - angle))
    robot.drive(Velocity(0.3 * math.cos(angle), 0.3 * math.sin(angle), 0.0))
    assert robot.run(2.0, stop_on_contact=True)
    assert robot.contact
    assert robot.pose.x_m == pytest.approx(4.9 - RADIUS, abs=SKIN_M)
    assert robot.pose.y_m == pytest.approx(0.0, abs=1e-9)


def test_an_edge_is_felt_as_well_as_a_flat_wall(robot: SimRobot):
    place(robot, 3.5, 1.7, math.radians(-135.0))  # towards the island's corner (2.7, 0.9)
    robot.drive(Velocity(0.5, 0.0, 0.0))
    assert robot.run(3.0, stop_on_contact=True)
    assert 0.0 < gap(robot.pose) <= SKIN_M


def test_blocked_translation_still_lets_it_turn(robot: SimRobot):
    place(robot, 4.6, 0.0, 0.0)
    robot.drive(Velocity(0.4, 0.0, 1.0))
    assert robot.run(1.0, stop_on_contact=False)
    assert robot.pose.heading_rad == pytest.approx(1.0)
    assert gap(robot.pose) >= GAP_M - 1e-9


def test_with_stop_on_contact_everything_stops_but_time(robot: SimRobot):
    place(robot, 4.6, 0.0, 0.0)
    robot.drive(Velocity(0.4, 0.0, 1.0))
    assert robot.run(1.0, stop_on_contact=True)
    assert robot.pose.heading_rad < 0.3
    assert robot.now_s() == 1.0
    stopped = robot.pose
    assert robot.run(1.0, stop_on_contact=True)  # standing at the wall is contact
    assert robot.pose == stopped


def test_pressing_goes_on_without_recovery_and_driving_off_is_no_contact(robot: SimRobot):
    place(robot, 4.6, 0.0, 0.0)
    robot.drive(ACTIONS[0])
    assert all(robot.run(CONFIG.period_s, stop_on_contact=False) for _ in range(5))
    robot.drive(Velocity(-0.2, 0.0, 0.0))
    assert not robot.run(0.5, stop_on_contact=True)
    assert not robot.contact


@pytest.mark.parametrize("action", [0, 1, 2])
def test_free_motion_is_the_exact_arc(robot: SimRobot, action: int):
    start = robot.pose
    assert not act(robot, action)
    exact = advance(start, ACTIONS[action], CONFIG.period_s)
    assert robot.pose.x_m == pytest.approx(exact.x_m, abs=1e-12)
    assert robot.pose.y_m == pytest.approx(exact.y_m, abs=1e-12)
    assert robot.pose.heading_rad == pytest.approx(exact.heading_rad, abs=1e-12)


def test_every_fine_step_agrees_with_plane_geometry(robot: SimRobot):
    """The clearance that motion relies on equals the distance to the nearest wall segment."""
    draw = np.random.default_rng(5)
    points = draw.uniform(-4.9, 4.9, (4000, 2))
    plane = WORLD.clearance(points) - RADIUS
    near = (plane > -0.05) & (plane < 0.45)
    for (x, y), expected in zip(points[near], plane[near], strict=True):
        assert abs(robot._scene.clearance(x, y) - expected) < 1e-5


def drive_on(robot: SimRobot, draw: np.random.Generator, actions: int) -> list[object]:
    seen: list[object] = []
    for _ in range(actions):
        if act(robot, int(draw.integers(3))):
            seen.append(back_off(robot, CONFIG, float(draw.uniform(-3, 3))))
        seen.append((robot.pose, robot.laps, robot.now_s()))
    seen.append(robot.sense().image.tobytes())
    return seen


def test_restored_in_the_same_process_it_continues_bit_for_bit(robot: SimRobot):
    drive_on(robot, np.random.default_rng(1), 60)
    saved = robot.state()
    first = drive_on(robot, np.random.default_rng(2), 60)
    robot.restore(saved)
    assert robot.state() == saved
    assert drive_on(robot, np.random.default_rng(2), 60) == first


def test_a_restored_robot_keeps_its_laps(robot: SimRobot):
    saved = fresh(robot).state()
    robot.restore({**saved, "laps_left": 3, "laps_right": 1})
    assert robot.laps == (2, 3, 1)
    robot.restore(saved)
    assert robot.laps == (0, 0, 0)


CONTINUE = """
import hashlib, json, sys
import numpy as np
from services.robot_driver.simulated.sim import SimRobot
from tests.unit.services.robot_driver.simulated.test_sim import CONFIG, WORLD, drive_on
robot = SimRobot(CONFIG, WORLD, 1)
robot.restore(json.loads(sys.argv[1]))
drive_on(robot, np.random.default_rng(2), 40)
image = hashlib.sha256(robot.sense().image.tobytes()).hexdigest()
sys.stdout.write(json.dumps([robot.state(), image]))
"""


def test_restored_in_another_process_it_continues_bit_for_bit(robot: SimRobot):
    drive_on(robot, np.random.default_rng(1), 60)
    saved = json.dumps(robot.state())
    drive_on(robot, np.random.default_rng(2), 40)
    image = hashlib.sha256(robot.sense().image.tobytes()).hexdigest()
    other = subprocess.run(
        [sys.executable, "-c", CONTINUE, saved], capture_output=True, check=True, text=True
    )
    assert json.loads(other.stdout) == [robot.state(), image]


def test_states_that_do_not_fit_are_refused_and_change_nothing(robot: SimRobot):
    good = robot.state()
    bad: list[tuple[dict[str, float | int | str], str]] = [
        ({}, "missing or unknown"),
        ({**good, "colour": 1}, "missing or unknown colour"),
        ({**good, "world_fingerprint": "0" * 16}, "another world"),
        ({**good, "x_m": 0.0}, "inside a wall"),
        ({**good, "x_m": 4.8}, "inside a wall"),
        ({**good, "x_m": 50.0}, "inside a wall"),
        ({**good, "x_m": math.nan}, "x_m must be a finite number"),
        ({**good, "world": "maze", "world_fingerprint": "0" * 16}, "no world named 'maze'"),
        ({**good, "obstacles": "[{}]"}, "obstacles: Field required"),
        ({**good, "obstacles": "boxes"}, "obstacles: Invalid JSON"),
        ({**good, "time_s": "soon"}, "time_s must be a finite number"),
    ]
    for state, message in bad:
        with pytest.raises(ValueError, match=message):
            robot.restore(state)
        assert robot.state() == good


def drive_round(robot: SimRobot, direction: int, part: float) -> None:
    """Slide along a square path round the island, the nose kept where it is."""
    corners = [(3.8, 0.0), (3.8, 2.0), (2.0, 2.0), (2.0, 3.8), (-2.0, 3.8), (-2.0, 2.0)]
    corners += [(-3.8, 2.0), (-3.8, -2.0), (-2.0, -2.0), (-2.0, -3.8), (2.0, -3.8), (2.0, -2.0)]
    corners += [(3.8, -2.0), (3.8, 0.0)]
    path = corners if direction > 0 else corners[::-1]
    for x, y in path[1 : 1 + round(part * (len(path) - 1))]:
        dx, dy = x - robot.pose.x_m, y - robot.pose.y_m
        heading = robot.pose.heading_rad
        c, s = math.cos(heading), math.sin(heading)
        robot.drive(Velocity(c * dx + s * dy, -s * dx + c * dy, 0.0))
        assert not robot.run(1.0, stop_on_contact=True)


@pytest.mark.parametrize(("direction", "expected"), [(1, (1, 1, 0)), (-1, (-1, 0, 1))])
def test_a_lap_counts_once_per_full_turn_in_its_direction(
    robot: SimRobot, direction: int, expected: tuple[int, int, int]
):
    drive_round(robot, direction, 0.9)
    assert robot.laps == (0, 0, 0)
    drive_round(fresh(robot), direction, 1.0)
    nudge(robot, direction)
    assert robot.laps == expected


def nudge(robot: SimRobot, direction: int) -> None:
    """Past the start: sums of angles may end a hair short of 2 pi there."""
    robot.drive(Velocity(0.1 * direction, 0.0, 0.0))
    robot.run(0.5, stop_on_contact=True)


def test_going_to_and_fro_over_the_line_counts_no_lap(robot: SimRobot):
    for direction in (1, -1) * 6:
        nudge(robot, direction)
    assert robot.laps == (0, 0, 0)


def test_laps_both_ways_cancel_in_the_net_count(robot: SimRobot):
    drive_round(robot, 1, 1.0)
    nudge(robot, 1)
    nudge(robot, -1)
    drive_round(robot, -1, 1.0)
    nudge(robot, -1)
    assert robot.laps == (0, 1, 1)


def test_circling_on_the_spot_is_no_lap(robot: SimRobot):
    for _ in range(90):
        assert not act(robot, 1)
    assert robot.laps == (0, 0, 0)


def test_camera_pictures_do_not_depend_on_earlier_ones(robot: SimRobot):
    first = robot.frame(150, 100)
    for heading in (0.0, 1.0, 2.0):
        robot.look_from(Pose(-3.8, 0.5, heading))
    again = robot.frame(150, 100)
    assert np.array_equal(first, again)
    assert again.shape == (100, 150, 3)


def test_left_in_the_picture_is_left_of_the_robot(robot: SimRobot):
    """Heading north in the east corridor, the island is on the left, the boundary on the right."""
    west = robot.look_from(Pose(3.8, -1.5, math.pi / 2 + 0.4))
    tree = WORLD.model_dump()
    tree["textures"]["green"] = {"kind": "plaster", "rgb": (0, 255, 0), "accent": (0, 255, 0)}
    tree["fixtures"] = ()
    other = SimRobot(CONFIG, World.model_validate(tree), 1)
    try:
        picture = other.look_from(Pose(3.8, -1.5, math.pi / 2)).astype(int)
    finally:
        other.close()
    green = picture[:, :, 1] > picture[:, :, 0] + 40
    assert green[:, 50:].mean() > 0.3
    assert green[:, :25].mean() < 0.05
    assert west.shape == (50, 75, 3)


def test_a_start_in_a_wall_is_refused():
    tree = WORLD.model_dump()
    tree["starts"] = [{"x_m": 4.8, "y_m": 0.0, "heading_deg": 0.0}]
    with pytest.raises(ValueError, match=r"starts\.0 touches a wall"):
        SimRobot(CONFIG, World.model_validate(tree), 1)


def test_closing_twice_is_harmless():
    robot = SimRobot(CONFIG, WORLD, 1)
    robot.close()
    robot.close()
