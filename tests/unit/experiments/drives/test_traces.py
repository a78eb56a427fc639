"""Figures of drives: what they count, on traces whose figures are known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.drives.places import Cells
from experiments.drives.traces import (
    Trace,
    bump_free_runs,
    circling,
    distances_m,
    figures,
    first_lap,
)
from experiments.records import EVALUATION_COLUMNS
from services.robot_driver.simulated.world import load_world

HORIZON = 50
STEP_M = 0.15
FARTHEST_M = HORIZON * STEP_M
TURN_RAD = math.radians(20.0)
CELLS = Cells(frozenset((x, y) for x in range(-8, 8) for y in range(-8, 8)), (0.0, 0.0))


def trace(bumps: str, places_m: list[tuple[float, float]], laps: tuple[int, int] = (0, 0)) -> Trace:
    """A drive in which `x` is an action that bumps."""
    places = np.array(places_m, np.float64)
    way_m = np.hypot(*np.diff(places, axis=0).T)
    return Trace(
        "plus", np.array([c == "x" for c in bumps]), places, np.zeros(len(places)), way_m, *laps
    )


def moving(turns_rad: list[float], steps_m: list[float] | None = None) -> Trace:
    """A drive without bumps by turns and steps."""
    steps = np.array(steps_m or [STEP_M] * len(turns_rad))
    headings = np.concatenate([[0.0], np.cumsum(turns_rad)])
    way = np.column_stack([np.cos(headings[:-1]), np.sin(headings[:-1])]) * steps[:, None]
    places = np.vstack([[0.0, 0.0], np.cumsum(way, axis=0)])
    wrapped = np.array([math.remainder(h, math.tau) for h in headings])
    return Trace("plus", np.zeros(len(steps), np.bool_), places, wrapped, steps, 0, 0)


def share(drive: Trace) -> float:
    return float(figures([drive], CELLS, HORIZON, FARTHEST_M)["circling"])


def test_figures_of_hand_made_drives() -> None:
    straight = trace("..x.", [(0, 0), (1, 0), (2, 0), (3, 0), (4, 0)], (2, 0))
    there_and_back = trace("....", [(0, 0), (0, 1), (0, 2), (0, 1), (0, 0)], (0, 1))
    found = figures([straight, there_and_back], CELLS, horizon=2, max_distance_m=2.0)
    assert found == {
        "actions": 8,
        "bumps": 1,
        "bumps_per_1000": 125.0,
        "bumps_per_100m": 12.5,
        "mean_run": pytest.approx((2 + 1 + 4) / 3),
        "longest_run": 4,
        "fitness": pytest.approx((2 + 1 + 4) / 3),
        "distance": pytest.approx((2 + 2 + 2 + 2 + 0 + 2) / 6 / 2),
        "laps_left_per_1000": 250.0,
        "laps_right_per_1000": 125.0,
        "coverage": 5 / 256,  # of the cells half a metre wide: x 0, 2, 4, 6 and y 0, 2, 4
        "circling": 0.0,
    } | {"coverage": found["coverage"]}
    assert found["coverage"] == pytest.approx(6 / 256)


def test_names_are_those_of_the_records_in_order() -> None:
    found = figures([moving([0.0] * 60)], CELLS, HORIZON, FARTHEST_M)
    first, beyond = map(EVALUATION_COLUMNS.index, ("actions", "wall_value"))
    assert list(found) == list(EVALUATION_COLUMNS[first:beyond])


def test_the_way_does_not_count_recoveries() -> None:
    drive = trace("x.", [(0, 0), (0.5, 0), (0.6, 0)])
    found = figures([replace(drive, way_m=np.array([0.05, 0.15]))], CELLS, HORIZON, FARTHEST_M)
    assert found["bumps_per_100m"] == pytest.approx(100 / 0.2)


def test_bumps_without_any_way_are_infinitely_many_per_metre() -> None:
    still = trace("x", [(0, 0), (0, 0)])
    assert figures([still], CELLS, HORIZON, FARTHEST_M)["bumps_per_100m"] == math.inf


def test_a_run_counts_as_500_at_most_in_the_fitness() -> None:
    found = figures([moving([0.0] * 700), moving([0.0] * 100)], CELLS, HORIZON, FARTHEST_M)
    assert (found["mean_run"], found["longest_run"], found["fitness"]) == (400.0, 700, 300.0)


@pytest.mark.parametrize(
    ("bumps", "runs"),
    [("...", [3]), ("x", [0]), ("xx.", [0, 0, 1]), (".x", [1]), (".x..x...", [1, 2, 3])],
)
def test_bump_free_runs(bumps: str, runs: list[int]) -> None:
    assert bump_free_runs(np.array([c == "x" for c in bumps])) == runs


@given(st.lists(st.booleans(), min_size=1, max_size=60))
def test_runs_and_bumps_together_are_all_actions(bumps: list[bool]) -> None:
    assert sum(bump_free_runs(np.array(bumps))) + sum(bumps) == len(bumps)


# ---------------------------------------------------------------- circling


def test_forward_left_for_ever_is_circling() -> None:
    assert share(moving([TURN_RAD] * 200)) == 1.0
    assert share(moving([-TURN_RAD] * 200)) == 1.0


def test_driving_straight_is_not_circling() -> None:
    assert share(moving([0.0] * 200)) == 0.0


def test_a_lap_round_an_island_is_not_circling() -> None:
    lap = ([0.0] * 30 + [TURN_RAD] * 4 + [TURN_RAD / 2]) * 8
    assert share(moving(lap)) == 0.0


def test_standing_at_a_wall_is_not_circling() -> None:
    assert share(moving([0.0] * 200, [0.0] * 200)) == 0.0


def test_turning_there_and_back_is_not_circling() -> None:
    """An eight gets as little anywhere, but its turns cancel; distance alone tells of it."""
    assert share(moving(([TURN_RAD] * 18 + [-TURN_RAD] * 18) * 6)) == 0.0


def test_bumping_again_and_again_is_not_circling() -> None:
    drive = moving([TURN_RAD] * 200)
    bumps = drive.bumps.copy()
    bumps[::HORIZON] = True
    assert share(replace(drive, bumps=bumps)) == 0.0


def test_a_single_circle_counts_while_it_is_the_last_50_actions() -> None:
    drive = moving([0.0] * 60 + [TURN_RAD] * 54 + [0.0] * 60)
    where = np.flatnonzero(circling(drive, HORIZON, FARTHEST_M))
    assert len(where)
    assert 60 + 18 < where[0] + HORIZON <= 60 + HORIZON
    assert where[-1] + HORIZON < 60 + 54 + 20


@given(st.lists(st.sampled_from([0.0, TURN_RAD, -TURN_RAD]), max_size=130), st.data())
def test_circling_agrees_with_the_definition_word_by_word(
    turns: list[float], data: st.DataObject
) -> None:
    drive = moving(turns) if turns else trace("", [(0, 0)])
    bumped = data.draw(st.sets(st.integers(0, max(len(turns) - 1, 0)), max_size=2))
    bumps = np.array([i in bumped for i in range(len(turns))], np.bool_)
    drive = replace(drive, bumps=bumps)
    found = circling(drive, HORIZON, FARTHEST_M)
    assert len(found) == max(len(turns) + 1 - HORIZON, 0)
    for i, value in enumerate(found):
        turned = abs(sum(turns[i : i + HORIZON]))
        near = math.dist(drive.places_m[i], drive.places_m[i + HORIZON]) < 0.2 * FARTHEST_M
        assert value == (turned > 2 * math.pi and near and not any(bumps[i : i + HORIZON]))


def test_short_drives_have_no_distance_and_no_circling() -> None:
    short = moving([TURN_RAD] * 10)
    assert len(distances_m(short.places_m, HORIZON)) == 0
    found = figures([short], CELLS, HORIZON, FARTHEST_M)
    assert (found["distance"], found["circling"]) == (0.0, 0.0)


# ---------------------------------------------------------------- laps


def round_the_island(circles: float, bump_at: int | None = None) -> Trace:
    """A drive round the centre of Plus, 100 actions each time."""
    angle = np.linspace(0.0, 2.0 * math.pi * circles, round(100 * abs(circles)) + 1)
    drive = trace("." * (len(angle) - 1), [(4.0 * math.cos(a), 4.0 * math.sin(a)) for a in angle])
    if bump_at is not None:
        drive.bumps[bump_at] = True
    return drive


@pytest.mark.parametrize(
    ("drive", "after"),
    [
        (round_the_island(1.5), 100), (round_the_island(-1.5), 100), (round_the_island(0.9), None),
        (round_the_island(1.5, bump_at=99), None), (round_the_island(1.5, bump_at=100), 100),
        (trace("..", [(4, 0), (4, 1), (4, 0)]), None),
    ],
)  # fmt: skip
def test_first_lap_is_once_round_without_a_bump(drive: Trace, after: int | None) -> None:
    assert first_lap(drive, load_world("plus")) == after


def test_there_and_back_is_no_lap() -> None:
    half = round_the_island(0.6).places_m
    places = np.vstack([half, half[::-1]])
    drive = trace("." * (len(places) - 1), [(x, y) for x, y in places])
    assert first_lap(drive, load_world("plus")) is None


def test_without_a_centre_there_are_no_laps() -> None:
    world = load_world("plus").model_copy(update={"lap": None})
    with pytest.raises(ValueError, match="'plus' has no lap centre"):
        first_lap(round_the_island(1.0), world)
