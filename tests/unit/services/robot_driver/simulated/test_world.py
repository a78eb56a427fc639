"""World files: typed, checked, refused with one clear line; geometry against naive oracles."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.robot_driver.simulated.world import (
    WORLDS,
    World,
    WorldError,
    load_world,
    read_world,
    world_files,
)
from services.robot_driver.simulated.world_parts import Obstacle

PLUS = (WORLDS / "plus.toml").read_text(encoding="utf-8")


def changed(folder: Path, old: str, new: str, count: int = 1) -> Path:
    assert old in PLUS
    path = folder / "plus.toml"
    path.write_text(PLUS.replace(old, new, count), encoding="utf-8")
    return path


def test_plus_is_a_corridor_of_constant_width_round_a_plus():
    world = load_world("plus")
    outer, island = world.walls
    assert len(outer.points) == len(island.points) == 12
    # The boundary is the plus dilated by a square: every corner is 2.2 m out along both axes.
    assert max(x for x, _ in outer.points) - max(x for x, _ in island.points) == pytest.approx(2.2)
    middle = (outer.lengths.sum() + island.lengths.sum()) / 2
    assert middle == pytest.approx(30.4)
    assert all(world.free(np.array([[s.x_m, s.y_m]]))[0] for s in world.starts)


def test_every_world_that_comes_along_can_be_read():
    for path in WORLDS.glob("*.toml"):
        assert read_world(path).name == path.stem


def test_reading_twice_gives_the_same_world_and_a_change_another_fingerprint(tmp_path: Path):
    world = load_world("plus")
    assert load_world("plus") == world
    other = read_world(changed(tmp_path, "height_m = 2.6", "height_m = 2.7"))
    assert other.fingerprint != world.fingerprint


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("height_m = 2.6", "height_m = -2.6", "plus.toml: height_m: "),
        ("height_m = 2.6", 'height_m = "high"', "plus.toml: height_m: "),
        ("height_m = 2.6", "heigth_m = 2.6", "plus.toml: height_m: Field required"),
        ("height_m = 2.6", "height_m = 2.6\nlight = 1", "plus.toml: light: Extra inputs"),
        ("height_m = 2.6", "height_m = 2.6\nheight_m = 2.7", "plus.toml: Cannot overwrite"),
        ('name = "plus"', 'name = "minus"', "name: 'minus' does not match the file name"),
        ('name = "island"', 'name = "outer"', "walls: two walls are named 'outer'"),
        ('texture = "linoleum"', 'texture = "lino"', "floor.texture: no texture named 'lino'"),
        ('"green", "green"', '"green", "grass"', "walls.0.textures.1: no texture named 'grass'"),
        ('"green", "green", ', '"green", ', "walls.0: expected 1 or 12 textures"),
        ("[4.9, 3.1]", "[4.9, -3.1]", "walls.0: two neighbouring points are the same"),
        ("[4.9, 3.1]", "[4.9, nan]", "walls.0.points.1.1: "),
        ("[4.9, 3.1]", "[4.9]", "walls.0.points.1.1: Field required"),
        ("x_m = 3.8", "x_m = 2.0", "starts.0: (2.0, 0.0) is not in free space"),
        ("centre = [0.0, 0.0]", "centre = [3.8, 0.0]", "lap.centre: a robot could drive over it"),
        ("segment = 0", "segment = 12", "fixtures.0.segment: 'outer' has 12 segments"),
        ("at_m = 1.0", "at_m = 0.4", "fixtures.0.at_m: does not fit onto a segment of 6.20 m"),
        ("at_m = 1.0", "at_m = 6.0", "fixtures.0.at_m: does not fit onto a segment of 6.20 m"),
        ('wall = "outer"', 'wall = "inner"', "fixtures.0.wall: no wall named 'inner'"),
        ("height_m = 2.1", "height_m = 2.7", "fixtures.0.height_m: higher than the wall"),
        ('kind = "door"', 'kind = "gate"', "fixtures.0.kind: Input should be 'door'"),
        ("rgb = [72, 96, 132]", "rgb = [72, 96, 256]", "fixtures.0.rgb.2: "),
        ("at_m = 1.0", "at_m = true", "fixtures.0.at_m: "),
        ("at_m = 1.0", 'at_m = 1.0\nstyle = "round"', "fixtures.0.style: Input should be"),
        ("at_m = 2.9", 'at_m = 2.9\nstyle = "flush"', "fixtures.1: style: only doors have one"),
    ],
)
def test_wrong_files_are_refused_with_one_line_naming_file_and_key(
    tmp_path: Path, old: str, new: str, message: str
):
    with pytest.raises(WorldError) as refused:
        read_world(changed(tmp_path, old, new))
    assert message in str(refused.value)
    assert str(refused.value).startswith("plus.toml: ")
    assert "\n" not in str(refused.value)


def test_loops_must_have_free_space_on_their_left():
    world = load_world("plus")
    tree = world.model_dump()
    tree["walls"][1]["points"] = tree["walls"][1]["points"][::-1]
    with pytest.raises(ValueError, match=r"walls\.1: .*clockwise"):
        World.model_validate(tree)
    tree = world.model_dump()
    tree["walls"][0]["points"] = tree["walls"][0]["points"][::-1]
    with pytest.raises(ValueError, match=r"walls\.0: .*clockwise"):
        World.model_validate(tree)


def test_unknown_worlds_and_unreadable_files_are_refused(tmp_path: Path):
    with pytest.raises(WorldError, match=r"no world named 'maze'; there are: .*plus"):
        load_world("maze")
    with pytest.raises(WorldError, match=r"gone\.toml"):
        read_world(tmp_path / "gone.toml")
    (tmp_path / "bad.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(WorldError, match=r"bad\.toml"):
        read_world(tmp_path / "bad.toml")


@given(x=st.floats(-6, 6), y=st.floats(-6, 6))
@settings(max_examples=200, deadline=None)
def test_clearance_matches_the_plus_written_out_by_hand(x: float, y: float):
    def in_plus(reach: float, half: float) -> bool:
        return (abs(x) < reach and abs(y) < half) or (abs(y) < reach and abs(x) < half)

    edges = [abs(abs(x) - c) for c in (0.9, 2.7, 3.1, 4.9)]
    edges += [abs(abs(y) - c) for c in (0.9, 2.7, 3.1, 4.9)]
    if min(edges) < 1e-6:
        return
    world = load_world("plus")
    point = np.array([[x, y]])
    assert world.free(point)[0] == (in_plus(4.9, 3.1) and not in_plus(2.7, 0.9))
    naive = min(
        math.dist((x, y), (ax + t * (bx - ax), ay + t * (by - ay)))
        for ax, ay, bx, by in world.segments
        for t in [
            min(
                1.0,
                max(
                    0.0,
                    ((x - ax) * (bx - ax) + (y - ay) * (by - ay))
                    / ((bx - ax) ** 2 + (by - ay) ** 2),
                ),
            )
        ]
    )
    assert abs(world.clearance(point)[0]) == pytest.approx(naive)


@given(x=st.floats(2.8, 4.8), y=st.floats(-3.0, 3.0), heading=st.floats(-4, 4))
@settings(max_examples=100, deadline=None)
def test_sight_ends_at_the_first_wall(x: float, y: float, heading: float):
    world = load_world("plus")
    far = float(world.sight(np.array([[x, y]]), np.array([heading]))[0])
    way = np.arange(0.0, far, 0.01)[:, None] * [[math.cos(heading), math.sin(heading)]] + [[x, y]]
    assert np.all(world.clearance(way) > -1e-9)
    behind = [[x + (far + 0.001) * math.cos(heading), y + (far + 0.001) * math.sin(heading)]]
    assert world.distance(np.array(behind))[0] <= 0.001 + 1e-9


BOX = """
[[obstacles]]
name = "box"
x_m = 0.0
y_m = 3.8
heading_deg = 30.0
length_m = 0.8
width_m = 0.4
height_m = 0.6
rgb = [200, 30, 30]
"""


def with_boxes(folder: Path, *boxes: str) -> World:
    path = folder / "plus.toml"
    path.write_text(PLUS + "".join(boxes), encoding="utf-8")
    return read_world(path)


@given(x=st.floats(-0.8, 0.8), y=st.floats(3.2, 4.4), heading=st.floats(-math.pi, math.pi))
@settings(max_examples=200, deadline=None)
def test_an_obstacle_is_off_free_space_and_ends_sight(x: float, y: float, heading: float):
    bare = load_world("plus")
    obstacle = Obstacle(
        name="box",
        x_m=0.0,
        y_m=3.8,
        heading_deg=30.0,
        length_m=0.8,
        width_m=0.4,
        height_m=0.6,
        rgb=(1, 2, 3),
    )
    world = World.model_validate({**bare.model_dump(), "obstacles": [obstacle.model_dump()]})
    c, s = math.cos(math.pi / 6), math.sin(math.pi / 6)

    def gap(px: float, py: float) -> float:
        """Signed distance to the box, by its own axes."""
        along = abs(px * c + (py - 3.8) * s) - 0.4
        across = abs((py - 3.8) * c - px * s) - 0.2
        return math.hypot(max(along, 0), max(across, 0)) + min(max(along, across), 0)

    if abs(gap(x, y)) < 1e-6:
        return
    point = np.array([[x, y]])
    assert world.free(point)[0] == (gap(x, y) > 0)
    expected = min(gap(x, y), float(bare.clearance(point)[0]))
    assert world.clearance(point)[0] == pytest.approx(expected)
    if gap(x, y) > 0:
        far = float(world.sight(point, np.array([heading]))[0])
        way = [(x + far * t * math.cos(heading), y + far * t * math.sin(heading)) for t in (0.5, 1)]
        assert min(gap(*place) for place in way) > -1e-9
        end = np.array([way[1]])
        assert min(gap(*way[1]), bare.distance(end)[0]) == pytest.approx(0.0, abs=1e-9)


def test_obstacles_are_read_from_the_file_and_change_its_fingerprint(tmp_path: Path):
    world = with_boxes(tmp_path, BOX)
    assert [obstacle.name for obstacle in world.obstacles] == ["box"]
    assert world.fingerprint != load_world("plus").fingerprint
    assert len(world.solid_segments) == len(world.segments) + 4
    assert load_world("plus").solid_segments.shape == world.segments.shape


def test_a_box_may_reach_into_a_wall_and_what_lies_in_both_is_not_free(tmp_path: Path):
    world = with_boxes(tmp_path, BOX.replace("y_m = 3.8", "y_m = 2.8"))
    assert not world.free(np.array([[0.0, 2.65], [0.0, 2.8]])).any()
    assert world.between_walls(np.array([[0.0, 2.8]]))[0]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("x_m = 0.0", "x_m = 4.8", "obstacles.0: obstacle 'box': expected x -4.9..4.9"),
        ("x_m = 0.0", "x_m = inf", "obstacles.0.x_m: "),
        ("height_m = 0.6", "height_m = 2.7", "obstacles.0: obstacle 'box': height_m 2.7 is higher"),
        ("height_m = 0.6", "height_m = 0.0", "obstacles.0.height_m: "),
        ("length_m = 0.8", "", "obstacles.0.length_m: Field required"),
        ('"box"', '"A Box"', "obstacles.0.name: "),
        (
            "x_m = 0.0\ny_m = 3.8",
            "x_m = 3.8\ny_m = 0.0",
            "starts.0: (3.8, 0.0) is not in free space",
        ),
    ],
)
def test_boxes_that_cannot_stand_there_are_refused(
    tmp_path: Path, old: str, new: str, message: str
):
    assert old in BOX
    with pytest.raises(WorldError) as refused:
        with_boxes(tmp_path, BOX.replace(old, new, 1))
    assert message in str(refused.value)


def test_two_boxes_of_one_name_are_refused(tmp_path: Path):
    with pytest.raises(WorldError, match="obstacles: two obstacles are named 'box'"):
        with_boxes(tmp_path, BOX, BOX)


ROUTE = """
[route]
points = [[3.8, 0.0], [3.8, 2.5], [3.3, 2.9]]

[[route.places]]
name = "east"
kind = "corridor"
x_m = 3.8
y_m = 0.0
"""


def with_route(folder: Path, route: str) -> World:
    path = folder / "plus.toml"
    path.write_text(PLUS + route, encoding="utf-8")
    return read_world(path)


def test_a_route_is_sampled_evenly_and_through_its_corners(tmp_path: Path):
    route = with_route(tmp_path, ROUTE).route
    assert route is not None
    assert route.length_m == pytest.approx(2.5 + math.hypot(0.5, 0.4))
    points = route.sample(0.1)
    steps = np.hypot(*np.diff(points, axis=0).T)
    assert steps.max() <= 0.1 + 1e-9
    assert steps.sum() == pytest.approx(route.length_m)
    for corner in route.points:
        assert np.hypot(*(points - corner).T).min() < 1e-9


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[3.3, 2.9]", "[3.3, 6.0]", "route.points: ("),
        ("[3.8, 2.5]", "[0.0, 2.0]", "route.points: ("),  # through the island
        ("points = [[3.8, 0.0], [3.8, 2.5], [3.3, 2.9]]", "points = [[3.8, 0.0]]", "route.points"),
        ("x_m = 3.8", "x_m = 0.0", "route.places.0: (0, 0) is not in free space"),
        ('"corridor"', '"lift"', "route.places.0.kind: Input should be 'dead-end'"),
    ],
)
def test_routes_through_walls_are_refused(tmp_path: Path, old: str, new: str, message: str):
    assert old in ROUTE
    with pytest.raises(WorldError) as refused:
        with_route(tmp_path, ROUTE.replace(old, new, 1))
    assert message in str(refused.value)


def test_two_places_of_one_name_are_refused(tmp_path: Path):
    place = ROUTE[ROUTE.index("[[route.places]]") :]
    with pytest.raises(WorldError, match=r"route.places: two are named 'east'"):
        with_route(tmp_path, ROUTE + place)


def own_world(folder: Path, name: str) -> Path:
    (folder / "worlds").mkdir(exist_ok=True)
    path = folder / "worlds" / f"{name}.toml"
    path.write_text(PLUS.replace('name = "plus"', f'name = "{name}"'), encoding="utf-8")
    return path


def test_a_file_in_the_folder_worlds_is_a_world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    before = list(world_files())
    assert {"plus", "minus", "i16c"} <= set(before)
    own_world(tmp_path, "attic")
    assert list(world_files()) == [*before, "attic"]
    assert load_world("attic").walls == load_world("plus").walls
    with pytest.raises(WorldError, match="there are: i16c, minus, plus, attic"):
        load_world("cellar")


def test_a_world_can_be_named_by_the_path_of_its_file(tmp_path: Path):
    path = own_world(tmp_path, "attic")
    assert load_world(str(path)).name == "attic"
    with pytest.raises(WorldError, match=r"cellar\.toml"):
        load_world(str(tmp_path / "cellar.toml"))


def test_own_worlds_do_not_take_the_names_of_those_that_come_along(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    own_world(tmp_path, "plus")
    with pytest.raises(WorldError, match=r"plus\.toml: a world named 'plus' comes along"):
        load_world("plus")
