"""Evaluation: the same starts and draws for whoever drives; where a robot can be."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import pytest

from experiments.drives import places
from experiments.drives.choosers import Planned, greedy, uniform
from experiments.drives.frozen_drives import drive, drive_from_first_start, evaluate
from experiments.drives.places import CELL_M, Cells, free_cells, reachable, start_poses
from experiments.drives.traces import first_lap
from experiments.environment import CorridorEnv
from services.robot_driver.robot import Pose
from services.robot_driver.simulated.world import WORLDS, World, load_world
from shared.config import Config
from shared.facts import FORWARD_LEFT

RADIUS_M = Config().robot.radius_m
NAMES = sorted(path.stem for path in WORLDS.glob("*.toml"))


@pytest.fixture
def env() -> Iterator[CorridorEnv]:
    env = CorridorEnv("plus")
    yield env
    env.close()


def hall(*, width_m: float, length_m: float = 10.0) -> World:
    """A straight corridor along x without a lap, from Plus's textures."""
    plus = load_world("plus")
    walls = plus.walls[0].model_copy(
        update={
            "points": ((0.0, 0.0), (length_m, 0.0), (length_m, width_m), (0.0, width_m)),
            "textures": ("green",),
        }
    )
    start = plus.starts[0].model_copy(update={"x_m": 1.0, "y_m": width_m / 2})
    changed = {"walls": (walls,), "fixtures": (), "starts": (start,), "lap": None}
    return plus.model_copy(update=changed)


# ---------------------------------------------------------------- starts


@pytest.mark.parametrize("name", NAMES)
def test_starts_are_the_same_every_time_and_can_be_driven_on_from(name: str) -> None:
    world = load_world(name)
    poses = start_poses(world, RADIUS_M, 16)
    assert poses == start_poses(world, RADIUS_M, 16)
    assert poses[:5] == start_poses(world, RADIUS_M, 5)
    assert len(set(poses)) == 16
    points = np.array([(pose.x_m, pose.y_m) for pose in poses])
    assert (world.clearance(points) > RADIUS_M + 0.1).all()


def test_starts_of_plus_keep_room_and_point_both_ways_round_the_island() -> None:
    world = load_world("plus")
    poses = start_poses(world, RADIUS_M, 40)
    points = np.array([(pose.x_m, pose.y_m) for pose in poses])
    assert (world.clearance(points) >= places.ROOM_M).all()
    ends = [pose for pose in poses if abs(pose.x_m) > 3.5 and abs(pose.y_m) < 1.0]
    assert len(ends) > 3, "there must be starts where the corridor's direction is plain"
    for pose in ends:
        north = (pose.x_m > 0.0) == (poses.index(pose) % 2 == 0)
        assert math.sin(pose.heading_rad) * (1.0 if north else -1.0) > 0.9


@pytest.mark.parametrize("width_m", [1.0, 3.0])
def test_starts_without_a_lap_have_the_nearest_wall_right_and_left_by_turns(width_m: float) -> None:
    world = hall(width_m=width_m, length_m=30.0)
    poses = start_poses(world, RADIUS_M, 20)
    for number, pose in enumerate(poses):
        if not 3.0 < pose.x_m < 27.0:  # the ends are the nearest wall there
            continue
        east = (pose.y_m < width_m / 2) == (number % 2 == 0)
        assert math.cos(pose.heading_rad) * (1.0 if east else -1.0) > 0.9
    assert len(poses) == 20


# ---------------------------------------------------------------- free space


def test_free_cells_of_a_hall_are_those_the_robot_fits_into() -> None:
    world = hall(width_m=2.0)
    points = reachable(world, 0.3)
    assert points.min(axis=0) == pytest.approx([0.325, 0.325])
    assert points.max(axis=0) == pytest.approx([9.675, 1.675])
    cells = free_cells(world, 0.3)
    assert cells.free == {(x, y) for x in range(20) for y in range(4)}
    assert free_cells(world, 0.6).free == {(x, y) for x in range(1, 19) for y in range(1, 3)}


def test_a_room_without_a_way_to_it_is_not_free() -> None:
    world = hall(width_m=2.0)
    box = load_world("plus").walls[0].model_copy(
        update={
            "name": "plug", "textures": ("green",),
            "points": ((6.0, 0.1), (6.0, 1.9), (6.5, 1.9), (6.5, 0.1)),
        }
    )  # fmt: skip
    cells = free_cells(world.model_copy(update={"walls": (*world.walls, box)}), 0.3)
    assert {x for x, _ in cells.free} == set(range(12))


def test_a_robot_that_fits_nowhere_is_refused() -> None:
    with pytest.raises(ValueError, match="fits at none of its starts"):
        free_cells(hall(width_m=0.5), 0.3)


def test_coverage_counts_each_free_cell_once() -> None:
    cells = Cells(frozenset({(0, 0), (1, 0), (2, 0), (3, 0)}), (10.0, 0.0))
    points = np.array([[10.1, 0.1], [10.2, 0.3], [11.1, 0.4], [11.1, 0.6], [0.0, 0.0]])
    assert cells.of(points) == {(0, 0), (2, 0)}
    assert cells.visited(points) == 0.5
    assert CELL_M == 0.5


# ---------------------------------------------------------------- drives


def test_a_circle_bumps_into_nothing_but_gets_nowhere(env: CorridorEnv) -> None:
    poses = [Pose(4.2, 0.0, math.pi / 2.0)]
    driven = drive(env, lambda seen, _: [FORWARD_LEFT] * len(seen), poses, 120)[0]
    assert not driven.bumps.any()
    assert np.ptp(driven.places_m, axis=0) == pytest.approx([0.86, 0.86], abs=0.03)
    assert driven.way_m == pytest.approx(np.full(120, 0.15), rel=0.01)
    assert (driven.laps_left, driven.laps_right) == (0, 0)


def test_drives_depend_on_nothing_but_who_drives(env: CorridorEnv) -> None:
    first = evaluate(env, uniform, starts=2, actions=40)
    env.reset(seed=9)
    for _ in range(3):
        env.step(np.int64(1))
    second = evaluate(env, uniform, starts=2, actions=40)
    assert first.figures == second.figures
    assert first.figures["actions"] == 80
    for a, b in zip(first.traces, second.traces, strict=True):
        assert np.array_equal(a.places_m, b.places_m)
        assert np.array_equal(a.bumps, b.bumps)
    assert not np.array_equal(first.traces[0].bumps, first.traces[1].bumps)


def test_recoveries_are_no_way_and_no_runs(env: CorridorEnv) -> None:
    driven = drive_from_first_start(env, lambda seen, _: [0] * len(seen), 60)
    assert driven.places_m[0].tolist() == [3.8, 0.0]
    bumped = np.flatnonzero(driven.bumps)
    assert len(bumped)
    moved = np.hypot(*np.diff(driven.places_m, axis=0).T)
    assert (driven.way_m[bumped] <= 0.15 + 1e-9).all()
    assert moved[bumped].max() > 0.25


class OneImage:
    """Prefers forward/right, always."""

    def all_values(self, images: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
        assert images.shape == (1, 50, 75)
        return np.array([[0.1, 0.2, 0.3]], np.float32)


def test_a_frozen_network_drives_greedily(env: CorridorEnv) -> None:
    driven = drive(env, greedy(OneImage()), [Pose(3.5, 0.0, math.pi / 2.0)], 9)[0]
    turned = math.remainder(driven.headings_rad[-1] - driven.headings_rad[0], math.tau)
    assert abs(turned) == pytest.approx(math.pi)
    assert driven.places_m[-1, 0] > 4.2, "to the right"


def test_the_planner_drives_laps_without_a_bump(env: CorridorEnv) -> None:
    planned = Planned(env.robot.world, env.config.robot)
    found = drive_from_first_start(env, planned, 200)
    assert not found.bumps.any()
    lap = first_lap(found, env.robot.world)
    assert lap is not None
    assert lap < 180
    assert (found.laps_left, found.laps_right) == (1, 0)
