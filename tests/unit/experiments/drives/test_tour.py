"""Test drives with turns on the spot (A45, E33)."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from experiments.drives.choosers import GREEDY
from experiments.drives.tour import BOX_NAME, drive_tour, passes, route_share
from experiments.environment import CorridorEnv
from experiments.records import TourRecord
from services.robot_driver.robot import Pose
from services.robot_driver.simulated.world import load_world
from shared.config import Config, PolicyConfig

Values = tuple[float, float, float]


class Scripted:
    """Predicts what a rule says; knows no images but how often it was asked."""

    def __init__(self, rule: Callable[[int], Values]) -> None:
        self.rule, self.asked = rule, 0

    def all_values(self, images: np.ndarray) -> np.ndarray:
        assert images.shape == (1, 50, 75)
        self.asked += 1
        return np.array([self.rule(self.asked)], np.float32)


@pytest.fixture(scope="module")
def env() -> Iterator[CorridorEnv]:
    config = Config.model_validate({"robot": {"world": "i16c"}})
    made = CorridorEnv(config=config)
    yield made
    made.close()


START = Pose(6.0, 0.0, 0.0)
MOST = 400


@pytest.mark.parametrize(("best", "sense"), [(0, -1.0), (1, 1.0), (2, -1.0)])
def test_a_negative_prediction_turns_on_the_spot_in_one_direction_until_it_is_none(
    env: CorridorEnv, best: int, sense: float
) -> None:
    """Left for forward/left, else right, whatever comes up on the way; 0 counts as drive."""

    def rule(asked: int) -> Values:
        if asked == 1:
            values = [-0.5, -0.5, -0.5]
            values[best] = -0.1
            return tuple(values)  # type: ignore[return-value]
        if asked == 2:  # another side would be better now: the direction stays
            return (-0.5, -0.1, -0.5) if sense < 0.0 else (-0.5, -0.5, -0.1)
        return (0.0, -0.5, -0.5)

    tour = drive_tour(env, Scripted(rule), START, 0, most_driven=MOST)
    headings = np.unwrap(tour.route.trace.headings_rad[:4])
    turn = env.config.robot.turn_rad_s * env.config.robot.period_s
    np.testing.assert_allclose(np.diff(headings), [sense * turn, sense * turn, 0.0], atol=1e-9)
    places = tour.route.trace.places_m
    np.testing.assert_allclose(places[0], places[2])
    assert tour.told.turned == 2
    assert tour.told.driven == MOST


def test_a_robot_that_finds_no_way_out_drives_on_after_two_full_turns(env: CorridorEnv) -> None:
    tour = drive_tour(env, Scripted(lambda _: (-0.1, -0.5, -0.5)), START, 0, most_driven=MOST)
    turn = np.rad2deg(env.config.robot.turn_rad_s * env.config.robot.period_s)
    per_drive = int(np.ceil(720.0 / turn))
    assert tour.told.turned == pytest.approx(per_drive * tour.told.driven, abs=per_drive)
    assert len(tour.route.trace.bumps) == 4 * MOST
    assert not tour.told.passed


def test_bumps_are_counted_and_told_and_the_box_is_taken_away(env: CorridorEnv) -> None:
    tour = drive_tour(env, Scripted(lambda _: (1.0, 0.0, 0.0)), START, 0, most_driven=MOST)
    told = [event.text for event in tour.route.events]
    assert tour.told.bumps == told.count("bumps") > 0
    assert [event.number for event in tour.route.events] == list(range(1, len(told) + 1))
    ways_m = tour.route.trace.way_m[tour.route.trace.bumps]  # without the way back from the wall
    robot = env.config.robot
    assert ways_m.max() <= robot.speed_m_s * robot.period_s + 1e-6
    assert BOX_NAME not in [obstacle.name for obstacle in env.robot.obstacles]
    assert not tour.told.passed


def test_a_policy_may_choose_what_seems_as_good(env: CorridorEnv) -> None:
    """E33: roulette turns aside where forward is hardly better; greedily it never does."""
    ways = []
    for policy in (GREEDY, PolicyConfig(kind="roulette", temperature=0.5)):
        network = Scripted(lambda _: (0.31, 0.3, 0.3))
        tour = drive_tour(env, network, START, 0, policy, most_driven=20)
        ways.append(np.unwrap(tour.route.trace.headings_rad[:6]))
    assert np.ptp(ways[0]) < 1e-6
    assert np.ptp(ways[1]) > 0.01


def test_a_full_drive_past_the_box_without_a_bump_passes_and_nothing_less() -> None:
    full = TourRecord(
        passed=False, driven=300, turned=9, bumps=0, route_share=0.6, bridges=("west", "east"),
        box_dropped=True,
    )  # fmt: skip
    assert passes(full)
    for less in (
        {"driven": 299}, {"route_share": 0.59}, {"bridges": ("west",)}, {"box_dropped": False},
        {"bumps": 1},
    ):  # fmt: skip
        assert not passes(full.model_copy(update=less))


def test_the_share_of_the_route_is_that_of_its_length() -> None:
    world = load_world("i16c")
    assert world.route is not None
    line = world.route.sample(0.1)
    assert route_share(world, line) == 1.0
    half = route_share(world, line[: len(line) // 2], near_m=0.2)
    assert half == pytest.approx(0.5, abs=0.02)
    assert route_share(world, np.array([[100.0, 100.0]])) == 0.0


def test_a_world_without_a_route_is_refused() -> None:
    env = CorridorEnv("plus")
    with pytest.raises(ValueError, match="'plus' has no route"):
        drive_tour(env, Scripted(lambda _: (1.0, 0.0, 0.0)), Pose(3.8, 0.0, 1.57), 0)
    env.close()
