"""The worlds that come along: what each of them is for is really possible in it (A3)."""

import math
from collections import Counter

import numpy as np
import pytest

from services.robot_driver.atlas.action_geometry import ActionGeometry
from services.robot_driver.atlas.inspection import problems
from services.robot_driver.atlas.planner import Planner
from services.robot_driver.atlas.survey import corridor_width
from services.robot_driver.simulated.world import WORLDS, World, load_world
from shared.config import RobotConfig

GEOMETRY = ActionGeometry.of(RobotConfig())
NAMES = sorted(path.stem for path in WORLDS.glob("*.toml"))


def starts(world: World) -> np.ndarray:
    return np.array([[s.x_m, s.y_m, math.radians(s.heading_deg)] for s in world.starts])


@pytest.mark.parametrize("name", NAMES)
def test_a_robot_fits_at_every_start_and_along_the_whole_route(name: str):
    world = load_world(name)
    assert np.all(world.clearance(starts(world)[:, :2]) > GEOMETRY.radius_m + 0.05)
    if world.route is not None:
        assert np.all(world.clearance(world.route.sample(0.05)) > GEOMETRY.radius_m)


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_wrong_with_the_worlds_that_come_along(name: str):
    assert problems(load_world(name), GEOMETRY) == []


def test_minus_is_a_hundred_actions_long_and_looks_nothing_like_plus():
    minus, plus = load_world("minus"), load_world("plus")
    assert len(minus.walls) == 1
    assert minus.lap is None
    x0, _, x1, _ = minus.bounds
    free = x1 - x0 - 2 * GEOMETRY.radius_m
    assert 80 <= free / GEOMETRY.step_m <= 120
    assert {t.kind for t in minus.textures.values()}.isdisjoint(
        t.kind for t in plus.textures.values()
    )


def test_in_minus_a_robot_turns_back_at_the_end_by_turning_actions_only():
    """Facing a dead end from 1.5 m, a planned run goes on; so the U-turn fits."""
    world = load_world("minus")
    planner = Planner(world, GEOMETRY, cell_m=0.1, headings=36, horizon=200)
    run = planner.drive(np.array([[6.3, 0.0, 0.0], [-6.3, 0.0, math.pi]]), 200)
    assert run.survived.tolist() == [200, 200]


def test_i16c_is_narrow_everywhere_and_its_one_chevron_door_is_the_only_unique_door():
    world = load_world("i16c")
    assert corridor_width(world) > 2 * GEOMETRY.radius_m + 0.3
    circle = 2 * (GEOMETRY.turning_radius_m + GEOMETRY.radius_m)
    # A corridor of 1.2 m: no wall is as far as a U-turn needs, except along corridors.
    assert circle > 1.2
    doors = Counter(f.look for f in world.fixtures if f.kind == "door")
    once = [look for look, count in doors.items() if count == 1]
    assert [style for _, style, _ in once] == ["chevron"]
    assert [f.name for f in world.fixtures if f.look == once[0]] == ["office"]


def test_the_tour_of_i16c_is_long_crosses_two_bridges_and_has_a_junction_near_its_end():
    route = load_world("i16c").route
    assert route is not None
    assert route.length_m / GEOMETRY.step_m > 300
    points = route.sample(0.1)
    along = {
        place.name: float(np.argmin(np.hypot(*(points - (place.x_m, place.y_m)).T))) / len(points)
        for place in route.places
        if np.hypot(*(points - (place.x_m, place.y_m)).T).min() < 0.1
    }
    kinds = {place.name: place.kind for place in route.places}
    assert sum(kinds[name] == "bridge" for name in along) == 2
    assert any(along[name] > 0.85 for name in along if kinds[name] == "junction")


@pytest.fixture(scope="module")
def i16c() -> Planner:
    return Planner(load_world("i16c"), GEOMETRY, cell_m=0.1, headings=36, horizon=120)


def test_in_i16c_runs_go_on_for_ever_from_starts_but_not_towards_dead_ends(i16c: Planner):
    ends = np.array(
        [
            [1.5, 0.0, math.pi], [15.6, 0.0, 0.0],
            [1.2, 5.0, math.pi], [16.0, 5.0, 0.0],
            [1.2, 10.0, math.pi], [14.5, 10.0, 0.0],
        ]
    )  # fmt: skip
    survived = i16c.drive(ends, 40).survived
    assert survived.max() < 30
    tour = i16c.drive(starts(i16c.world)[:1], 300)
    assert tour.survived[0] == 300
