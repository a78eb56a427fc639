"""The worlds that come along: what each of them is for is really possible in it (A3)."""

import math

import numpy as np
import pytest

from services.robot_driver.planner import Motion, Planner
from services.robot_driver.world import WORLDS, World, load_world
from shared.config import RobotConfig

MOTION = Motion.of(RobotConfig())
NAMES = sorted(path.stem for path in WORLDS.glob("*.toml"))


def starts(world: World) -> np.ndarray:
    return np.array([[s.x_m, s.y_m, math.radians(s.heading_deg)] for s in world.starts])


@pytest.mark.parametrize("name", NAMES)
def test_a_robot_fits_at_every_start_and_along_the_whole_route(name: str):
    world = load_world(name)
    assert np.all(world.clearance(starts(world)[:, :2]) > MOTION.radius_m + 0.05)
    if world.route is not None:
        assert np.all(world.clearance(world.route.sample(0.05)) > MOTION.radius_m)


def test_minus_is_a_hundred_actions_long_and_looks_nothing_like_plus():
    minus, plus = load_world("minus"), load_world("plus")
    assert len(minus.walls) == 1
    assert minus.lap is None
    x0, _, x1, _ = minus.bounds
    free = x1 - x0 - 2 * MOTION.radius_m
    assert 80 <= free / MOTION.step_m <= 120
    assert {t.kind for t in minus.textures.values()}.isdisjoint(
        t.kind for t in plus.textures.values()
    )


def test_in_minus_a_robot_turns_back_at_the_end_by_turning_actions_only():
    """Facing a dead end from 1.5 m, a planned run goes on; so the U-turn fits."""
    world = load_world("minus")
    planner = Planner(world, MOTION, cell_m=0.1, headings=36, horizon=200)
    run = planner.drive(np.array([[6.3, 0.0, 0.0], [-6.3, 0.0, math.pi]]), 200)
    assert run.survived.tolist() == [200, 200]
