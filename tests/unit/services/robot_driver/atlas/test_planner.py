"""The planner against brute force on a tiny world, and against the simulated robot on Plus."""

import itertools
import math

import numpy as np
import pytest

from services.robot_driver.atlas.action_geometry import CONTACT_M, ActionGeometry
from services.robot_driver.atlas.planner import Planner
from services.robot_driver.atlas.survey import corridor_width, drive_randomly
from services.robot_driver.robot import Pose, Velocity
from services.robot_driver.simulated.kinematics import advance
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import World, load_world
from shared.config import RobotConfig

CONFIG = RobotConfig()
GEOMETRY = ActionGeometry.of(CONFIG)
ACTIONS = [Velocity(CONFIG.speed_m_s, 0.0, turn * CONFIG.turn_rad_s) for turn in (0.0, 1.0, -1.0)]


def room(width: float, depth: float) -> World:
    """One rectangular room without an island."""
    points = [(0.0, 0.0), (width, 0.0), (width, depth), (0.0, depth)]
    return World.model_validate(
        {
            "name": "room",
            "title": "A room",
            "height_m": 2.0,
            "floor": {"texture": "grey"},
            "ceiling": {"texture": "grey"},
            "textures": {"grey": {"kind": "plaster", "rgb": [128, 128, 128]}},
            "walls": [{"name": "room", "points": points, "textures": ["grey"]}],
            "starts": [{"x_m": width / 2, "y_m": depth / 2, "heading_deg": 0.0}],
        }
    )


def random_poses(world: World, count: int, seed: int) -> np.ndarray:
    draw = np.random.default_rng(seed)
    x0, y0, x1, y1 = world.bounds
    points = draw.uniform((x0, y0), (x1, y1), (50 * count, 2))
    points = points[world.clearance(points) > GEOMETRY.radius_m + 0.01][:count]
    return np.column_stack([points, draw.uniform(-math.pi, math.pi, len(points))])


def longest_by_brute_force(world: World, poses: np.ndarray, depth: int) -> np.ndarray:
    """Most actions that any of all 3^depth sequences survives, from each pose."""
    best = np.zeros(len(poses), np.int64)
    origin, here = np.arange(len(poses)), poses
    for k in range(1, depth + 1):
        safe = [GEOMETRY.gap(world, here, action) > CONTACT_M for action in range(3)]
        moved = [GEOMETRY.move(here, action) for action in range(3)]
        here = np.vstack([m[s] for m, s in zip(moved, safe, strict=True)])
        origin = np.hstack([origin[s] for s in safe])
        best[origin] = k
    return best


def test_plans_agree_with_all_sequences_in_a_room_just_large_enough_to_circle_in():
    """Soundness exactly; completeness but for poses at the very edge of what the grid resolves."""
    world, depth = room(1.9, 1.7), 8
    poses = random_poses(world, 60, 1)
    possible = longest_by_brute_force(world, poses, depth) == depth
    planner = Planner(world, GEOMETRY, cell_m=0.02, headings=72, horizon=60)
    planned = planner.drive(poses, 60)
    assert np.all(possible[planned.survived >= depth])
    assert 0.2 < possible.mean() < 0.8
    assert (possible == (planned.survived == 60)).mean() > 0.95


def test_in_a_large_room_nearly_every_pose_off_the_walls_is_saved_and_none_at_a_wall_head_on():
    world = room(6.0, 6.0)
    planner = Planner(world, GEOMETRY, cell_m=0.1, headings=36, horizon=100)
    middle = np.array([[3.0, 3.0, 0.3]])
    head_on = np.array([[6.0 - GEOMETRY.radius_m - 0.2, 3.0, 0.0]])
    assert planner.drive(middle, 200).survived[0] == 200
    assert planner.drive(head_on, 200).survived[0] < 3


@pytest.fixture(scope="module")
def plus() -> Planner:
    return Planner(load_world("plus"), GEOMETRY, cell_m=0.1, headings=36, horizon=60)


def test_planned_runs_are_driven_by_the_simulated_robot_without_contact(plus: Planner):
    start = np.array([[3.8, 0.0, math.pi / 2]])
    run = plus.drive(start, 150)
    assert run.survived[0] == 150
    robot = SimRobot(CONFIG, plus.world, 1)
    try:
        for action, pose in zip(run.actions[:, 0], run.poses[1:, 0], strict=True):
            robot.drive(ACTIONS[action])
            assert not robot.run(CONFIG.period_s, stop_on_contact=True)
            assert (robot.pose.x_m, robot.pose.y_m) == pytest.approx(tuple(pose[:2]), abs=1e-9)
    finally:
        robot.close()


def test_planned_laps_go_round_in_either_direction(plus: Planner):
    laps = []
    for direction in (1, -1):
        pose = np.array([3.8, 0.0, direction * math.pi / 2])
        run = plus.race(pose, 300, direction)
        assert run.survived[0] == 300
        laps.append(300 / (plus.winding(run.poses[:, 0])[-1] * direction / (2 * math.pi)))
    # 150 is the thesis's lap (A4); a plan with full knowledge cuts every corner.
    assert 110 < laps[0] < 160
    assert laps[0] == pytest.approx(laps[1], rel=0.03)


def test_motion_is_that_of_the_simulated_robot():
    poses = random_poses(room(4.0, 4.0), 20, 3)
    for action, part in itertools.product(range(3), (0.3, 1.0)):
        moved = GEOMETRY.move(poses, action, part)
        for (x, y, h), after in zip(poses, moved, strict=True):
            exact = advance(
                Pose(float(x), float(y), float(h)), ACTIONS[action], CONFIG.period_s * part
            )
            assert (exact.x_m, exact.y_m) == pytest.approx(tuple(after[:2]))
            assert math.cos(exact.heading_rad - after[2]) == pytest.approx(1.0)


def test_worlds_without_lap_centre_have_no_races():
    planner = Planner(room(3.0, 3.0), GEOMETRY, cell_m=0.2, headings=12, horizon=5)
    with pytest.raises(ValueError, match="no lap centre"):
        planner.race(np.array([1.5, 1.5, 0.0]), 5, 1)


def test_width_is_measured_straight_across():
    assert corridor_width(load_world("plus")) == pytest.approx(2.2)
    assert corridor_width(room(3.0, 2.0)) == pytest.approx(2.0)


def test_random_driving_bumps_after_10_to_16_actions_on_plus():
    """The calibration of A4 and of the rules for scored presets; survey gives the full figures."""
    robot = SimRobot(CONFIG, load_world("plus"), 1)
    try:
        driven = drive_randomly(robot, 250, 1)
    finally:
        robot.close()
    assert 9.0 < driven.runs.mean() < 17.0
    assert driven.retreats_m.mean() > 0.45
    clear = robot.world.clearance(driven.poses[:, :2]) - GEOMETRY.radius_m
    assert clear.min() > CONTACT_M
