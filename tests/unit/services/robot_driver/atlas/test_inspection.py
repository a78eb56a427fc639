"""Problems of worlds: each is built on purpose, found, and named once; sound worlds have none."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from services.robot_driver.atlas.action_geometry import ActionGeometry
from services.robot_driver.atlas.inspection import Reach, problems
from services.robot_driver.simulated.world import World
from shared.config import RobotConfig

GEOMETRY = ActionGeometry.of(RobotConfig())
ROOM = [(0.0, 0.0), (6.0, 0.0), (6.0, 4.0), (0.0, 4.0)]
Loop = list[tuple[float, float]]


def world(*loops: Loop, **more: Any) -> World:
    """A world of a boundary and islands, with a start at (1, 1) unless another is given."""
    tree = {
        "name": "test",
        "title": "Test",
        "height_m": 2.5,
        "floor": {"texture": "grey"},
        "ceiling": {"texture": "grey"},
        "textures": {"grey": {"kind": "plaster", "rgb": (128, 128, 128)}},
        "walls": [
            {"name": f"loop-{i}", "points": loop, "textures": ("grey",)}
            for i, loop in enumerate(loops)
        ],
        "starts": [{"x_m": 1.0, "y_m": 1.0, "heading_deg": 0.0}],
        **more,
    }
    return World.model_validate(tree)


def box(x0: float, y0: float, x1: float, y1: float) -> Loop:
    """A rectangle run clockwise, as islands are."""
    return [(x0, y0), (x0, y1), (x1, y1), (x1, y0)]


def obstacle(**fields: Any) -> dict[str, Any]:
    standing = {"name": "box", "heading_deg": 0.0, "height_m": 1.0, "rgb": (9, 9, 9)}
    return {**standing, **fields}


def start(x: float, y: float) -> dict[str, float]:
    return {"x_m": x, "y_m": y, "heading_deg": 0.0}


def found(*loops: Loop, **more: Any) -> str:
    lines = problems(world(*loops, **more), GEOMETRY)
    assert all("\n" not in line for line in lines)
    return "\n".join(lines)


def test_a_plain_room_with_an_island_is_sound():
    assert found(ROOM, box(2.5, 1.5, 4.0, 2.5)) == ""


@pytest.mark.parametrize(
    "loops",
    [
        [ROOM, box(5.0, 1.0, 7.0, 2.0)],  # an island reaches through the boundary
        [ROOM, box(2.0, 2.0, 3.5, 3.0), box(3.0, 1.5, 4.5, 2.5)],  # two islands cross
        [ROOM, box(2.0, 1.0, 3.0, 2.0), box(3.0, 2.0, 4.0, 3.0)],  # they touch at a corner
        [ROOM, box(3.0, 0.0, 4.0, 2.0)],  # an island shares a wall with the boundary
        [[(0, 0), (6, 0), (6, 4), (2, 4), (2, -1), (1, -1), (1, 4), (0, 4)]],  # itself
    ],
)
def test_loops_that_cross_or_touch_are_found(loops: list[Loop]):
    text = found(*loops, starts=[start(0.5, 0.5)])
    assert "meet at (" in text
    assert "neither cross nor touch" in text


@given(x=st.floats(-1.5, 6.5), y=st.floats(-1.5, 4.5), turn=st.floats(0.0, 1.5))
@settings(max_examples=150, deadline=None)
def test_an_island_anywhere_meets_the_boundary_exactly_if_it_lies_on_both_sides(
    x: float, y: float, turn: float
):
    """Oracle: points close together all along the island are inside, outside, or both."""
    assume(math.hypot(x - 1.0, y - 1.0) > 0.7)  # the start
    c, s = math.cos(turn), math.sin(turn)
    island = [(x + c * u - s * v, y + s * u + c * v) for u, v in box(-0.5, -0.3, 0.5, 0.3)]
    part = np.linspace(0.0, 1.0, 400)[:, None]
    corners = np.array([*island, island[0]])
    line = np.vstack([a + part * (b - a) for a, b in itertools.pairwise(corners)])
    depth = np.minimum.reduce([line[:, 0], 6.0 - line[:, 0], line[:, 1], 4.0 - line[:, 1]])
    assume(min(abs(depth.min()), abs(depth.max()), abs(depth[0])) > 0.01)  # too close to call
    lines = problems(world(ROOM, island), GEOMETRY)
    assert any("meet at" in line for line in lines) == (depth.min() < 0.0 < depth.max())
    assert any("outside the boundary" in line for line in lines) == bool(depth[0] < 0.0)


def test_a_wall_that_runs_back_over_itself_is_found():
    spike: Loop = [(0, 0), (6, 0), (6, 4), (3, 4), (3, 2), (3, 3.9), (2.9, 4), (0, 4)]
    assert "runs back over it" in found(spike)


def test_islands_outside_or_inside_each_other_are_found():
    assert "island 'loop-1' lies outside" in found(ROOM, box(8.0, 1.0, 9.0, 2.0))
    nested = found(ROOM, box(2.0, 1.5, 5.0, 3.5), box(3.0, 2.0, 4.0, 3.0))
    assert "island 'loop-2' lies inside 'loop-1'" in nested


def test_laps_need_an_island_to_go_round():
    lap = {"centre": (8.0, 2.0), "line": ((6.0, 2.0), (6.5, 2.0))}
    assert "lap.centre: lies on no island" in found(ROOM, box(2.5, 1.5, 4.0, 2.5), lap=lap)


@pytest.mark.parametrize(
    ("thickness", "reason"),
    [
        (0.008, "one step of the simulation"),
        (0.05, "the solid behind each wall"),
        (0.12, "one action is long"),
        (0.16, ""),
    ],
)
def test_walls_thinner_than_motion_or_simulation_can_bear_are_found(thickness: float, reason: str):
    edge = 2.0 + thickness
    slab: Loop = [(2.0, 1.5), (2.0, 2.5), (edge, 2.6), (edge, 1.6)]
    text = found(ROOM, slab)
    assert (reason in text) if reason else (text == "")
    if reason:
        assert f"{thickness:.3f} m apart" in text


def test_a_passage_is_no_wall_however_narrow():
    assert found(ROOM, box(2.0, 1.5, 3.0, 2.5), box(3.1, 1.5, 4.0, 2.5)) == ""


def test_starts_that_touch_are_found_and_the_others_still_looked_at():
    text = found(ROOM, starts=[start(0.2, 1.0), start(1.0, 1.0)])
    assert text.startswith("starts.0: (0.2, 1) touches a wall or an obstacle (gap -0.025 m)")
    assert "starts.1" not in text
    standing = obstacle(x_m=1.3, y_m=1.0, length_m=0.2, width_m=0.2)
    assert "starts.0: (1, 1) touches" in found(ROOM, obstacles=[standing])


def halved(gap_m: float) -> list[dict[str, Any]]:
    """A row of boxes across the room that leaves one gap."""
    return [obstacle(x_m=3.0, y_m=(4.0 - gap_m) / 2, length_m=0.3, width_m=4.0 - gap_m)]


def test_starts_and_places_beyond_a_gap_too_narrow_cannot_be_reached():
    both = [start(1.0, 1.0), start(5.0, 1.0)]
    place = {"name": "far", "kind": "corridor", "x_m": 5.0, "y_m": 1.0}
    route = {"points": [(1.0, 1.0), (5.0, 1.0)], "places": [place]}
    closed = found(ROOM, starts=both, route=route, obstacles=halved(0.44))
    assert "starts.1: (5, 1) cannot be reached from starts.0" in closed
    assert "route.places.0: 'far' cannot be reached from starts.0" in closed
    assert found(ROOM, starts=both, route=route, obstacles=halved(0.50)) == ""


def test_parts_that_nobody_can_enter_are_found_with_their_area():
    text = found(ROOM, obstacles=halved(0.3))
    # 2.85 m x 4 m, less a rim of the robot's radius.
    assert "a part of 8.5 m2 round (" in text
    assert "cannot be reached from any start" in text


def test_a_start_without_room_for_one_action_is_shut_in():
    cell = [
        obstacle(name=f"side-{i}", x_m=1.0 + dx, y_m=1.0 + dy, length_m=a, width_m=b)
        for i, (dx, dy, a, b) in enumerate(
            [(0.4, 0, 0.3, 1.2), (-0.4, 0, 0.3, 1.2), (0, 0.4, 1.2, 0.3), (0, -0.4, 1.2, 0.3)]
        )
    ]
    assert "starts.0: (1, 1) is shut in" in found(ROOM, obstacles=cell)


def test_the_area_that_can_be_reached_is_that_of_the_room_less_a_rim():
    reach = Reach(world(ROOM), 0.3)
    assert reach.count == 1
    assert reach.area_m2(1) == pytest.approx(5.4 * 3.4, rel=0.02)
    assert reach.size_m(1) == pytest.approx(5.4, abs=0.05)
    assert reach.part_of(3.0, 2.0) == 1
    assert reach.part_of(0.1, 0.1) == 0


def fixture(at_m: float, bottom_m: float) -> dict[str, Any]:
    size = {"width_m": 1.0, "height_m": 1.0, "rgb": (1, 2, 3)}
    return {
        "wall": "loop-0", "segment": 0, "kind": "board", "at_m": at_m, "bottom_m": bottom_m, **size,
    }  # fmt: skip


@pytest.mark.parametrize(("at_m", "bottom_m", "overlap"), [
    (2.5, 0.5, True), (3.0, 0.5, False), (2.0, 1.0, False), (2.0, 0.9, True),
])  # fmt: skip
def test_fixtures_over_each_other_are_found(at_m: float, bottom_m: float, overlap: bool):
    text = found(ROOM, fixtures=[fixture(2.0, 0.0), fixture(at_m, bottom_m)])
    assert (text == "fixtures.0 and fixtures.1: board and board overlap") == overlap
    assert bool(text) == overlap


def test_textures_nobody_sees_are_found():
    grey = {"kind": "plaster", "rgb": (128, 128, 128)}
    assert found(ROOM, textures={"grey": grey, "pink": grey}) == "textures.pink: used nowhere"
