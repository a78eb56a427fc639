"""Measures a world and a motion together: what can be driven, and how hard it is (A4, E31).

`corridor world check` prints the result of `problems_in`, or, if there are none, of `survey`.
"""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from services.robot_driver.atlas.action_geometry import TURNS, ActionGeometry
from services.robot_driver.atlas.inspection import problems
from services.robot_driver.atlas.planner import Planner
from services.robot_driver.recovery import back_off
from services.robot_driver.robot import Velocity
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import World, WorldError, read_world
from shared.config import Config

Figures = dict[str, float | int | str | bool]

PLANNED_ACTIONS = 500
"""A pose counts as saved when a planned run of this many actions exists from it (A9)."""
COMFORTABLE_M = 0.4
"""Room to all walls on the lap that stands for an ordinary driving line."""
_RECOVERIES = 1000
_RACE_ACTIONS = 600
_SPACING_M = 0.1
"""Distance of the places at which the width is measured."""


class RandomDrive(NamedTuple):
    """What a robot met that chose actions uniformly at random and recovered after each bump."""

    runs: npt.NDArray[np.int64]
    """[n]: actions without a bump before each bump."""
    poses: npt.NDArray[np.float64]
    """[n, 3]: x, y, heading after each recovery."""
    retreats_m: npt.NDArray[np.float64]
    """[n]: way won by each recovery."""


def problems_in(path: Path, config: Config) -> list[str]:
    """What is wrong with a world file for the configured robot, one line each."""
    try:
        world = read_world(path)
    except WorldError as error:
        return [str(error)]
    return problems(world, ActionGeometry.of(config.robot))


def survey(config: Config, world: World) -> Figures:
    """Measure the configured robot in a world, about a minute for each hundred square metres.

    The figures have names; lengths are in metres, angles in degrees.
    """
    geometry = ActionGeometry.of(config.robot)
    robot = SimRobot(config.robot, world, config.run.seed)
    try:
        driven = drive_randomly(robot, _RECOVERIES, config.run.seed)
    finally:
        robot.close()
    planner = Planner(world, geometry, horizon=PLANNED_ACTIONS)
    best = planner.drive(_start_poses(world)[:1], PLANNED_ACTIONS)
    saved = planner.drive(driven.poses, PLANNED_ACTIONS).survived
    return {
        "world": world.name,
        **_geometry(world, geometry),
        "best_fitness_from_start": int(best.survived[0]),
        **_laps(planner),
        "random_actions_to_bump_mean": float(driven.runs.mean()),
        "random_actions_to_bump_median": float(np.median(driven.runs)),
        "random_bumps_in_first_action": float((driven.runs == 0).mean()),
        "retreat_mean_m": float(driven.retreats_m.mean()),
        "recoveries": len(driven.runs),
        f"recoveries_saved_for_{PLANNED_ACTIONS}_actions": float(np.mean(saved >= PLANNED_ACTIONS)),
        "best_fitness_after_recovery_mean": float(saved.mean()),
    }


def drive_randomly(robot: SimRobot, bumps: int, seed: int) -> RandomDrive:
    """Drive random actions until this many bumps, each followed by `back_off` (E9, E11)."""
    config = robot.config
    draw = np.random.default_rng(seed)
    turns = [turn * config.turn_rad_s for turn in TURNS]
    found: list[tuple[int, tuple[float, float, float], float]] = []
    actions = 0
    while len(found) < bumps:
        robot.drive(Velocity(config.speed_m_s, 0.0, turns[int(draw.integers(3))]))
        if robot.run(config.period_s, stop_on_contact=True):
            won_m = back_off(robot, config, float(draw.uniform(-math.pi, math.pi)))
            pose = (robot.pose.x_m, robot.pose.y_m, robot.pose.heading_rad)
            found.append((actions, pose, won_m))
            actions = 0
        else:
            actions += 1
    return RandomDrive(*(np.array(column) for column in zip(*found, strict=True)))


def corridor_width(world: World) -> float:
    """Smallest distance straight across from any wall to what stands opposite it."""
    return min(float(_widths(world, segment).min()) for segment in world.segments)


def _widths(world: World, segment: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Distances straight across from places on one wall segment; inf where an obstacle stands."""
    ax, ay, bx, by = segment
    along = np.array([bx - ax, by - ay])
    length = float(np.hypot(*along))
    part = (np.arange(max(1, round(length / _SPACING_M))) + 0.5) * _SPACING_M / length
    points = (ax, ay) + np.minimum(part, 0.5 if len(part) == 1 else 1.0)[:, None] * along
    across = np.array([-along[1], along[0]]) / length
    far = world.sight(points, np.full(len(points), math.atan2(across[1], across[0])))
    bare = world.clearance(points + 0.01 * across) > 0.005  # else along the side of an obstacle
    return np.where(bare, far, np.inf)


def _geometry(world: World, geometry: ActionGeometry) -> Figures:
    width = corridor_width(world)
    circle = geometry.turning_radius_m + geometry.radius_m
    x0, y0, x1, y1 = world.bounds
    grid = np.mgrid[x0:x1:0.05, y0:y1:0.05].reshape(2, -1).T
    return {
        "step_m": geometry.step_m,
        "turn_per_action_deg": math.degrees(geometry.turn_rad),
        "turning_radius_m": geometry.turning_radius_m,
        "corridor_width_m": width,
        "full_circle_needs_width_m": 2.0 * circle,
        "full_circle_fits_narrowest_part": 2.0 * circle < width,
        "full_circle_fits_somewhere": circle < float(world.clearance(grid).max()),
    }


def _laps(planner: Planner) -> Figures:
    world = planner.world
    if world.lap is None:
        return {}
    figures: Figures = {}
    if len(world.walls) == 2:
        middle = _centre_line_lap(world)
        figures["centre_line_lap_m"] = middle
        figures["centre_line_lap_actions"] = middle / planner.geometry.step_m
    for name, direction, keep in (
        ("fastest_lap_left_actions", 1, 0.005),
        ("fastest_lap_right_actions", -1, 0.005),
        ("comfortable_lap_actions", 1, COMFORTABLE_M),
    ):
        starts = _start_poses(world)
        figures[name] = min(_actions_per_lap(planner, pose, direction, keep) for pose in starts)
    return figures


def _actions_per_lap(
    planner: Planner, pose: npt.NDArray[np.float64], direction: int, keep_m: float
) -> float:
    """Mean of one long run from a start; inf if it does not get round."""
    run = planner.race(pose, _RACE_ACTIONS, direction, keep_m)
    survived = int(run.survived[0])
    angle = float(planner.winding(run.poses[: survived + 1, 0])[-1])
    laps = direction * angle / (2.0 * math.pi)
    return survived / laps if laps > 0.5 else math.inf


def _centre_line_lap(world: World) -> float:
    """Length of a lap at half the width of the narrowest side from the one island, cornered."""
    island = world.walls[1]
    width = min(float(np.median(_widths(world, segment))) for segment in island.segments)
    ways = np.diff(np.array([*island.points, *island.points[:2]], np.float64), axis=0)
    turns = np.diff(np.arctan2(ways[:, 1], ways[:, 0]))
    # Clockwise, so a corner that sticks out turns right and makes the way longer.
    mitres = np.tan(-np.remainder(turns + np.pi, 2 * np.pi) / 2.0 + np.pi / 2.0)
    return float(island.lengths.sum() + width * mitres.sum())


def _start_poses(world: World) -> npt.NDArray[np.float64]:
    """x, y, heading of all starts, float64 [n, 3]."""
    poses = [(s.x_m, s.y_m, math.radians(s.heading_deg)) for s in world.starts]
    return np.array(poses, np.float64)
