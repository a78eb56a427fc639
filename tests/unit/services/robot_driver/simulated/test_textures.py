"""Textures: deterministic, sized as the wall, mirror-true, distinguishable."""

import hashlib
import itertools
from typing import get_args

import numpy as np
import pytest

from services.robot_driver.simulated.textures import TEXELS_PER_M, flat_tile, wall_picture
from services.robot_driver.simulated.world import World, load_world
from services.robot_driver.simulated.world_parts import DoorStyle, Material, Texture

WORLD = load_world("plus")
PLACES = [(wall, i) for wall in WORLD.walls for i in range(len(wall.points))]


def test_equal_data_gives_equal_pixels():
    def fingerprint() -> str:
        pictures = (wall_picture(WORLD, wall, i).tobytes() for wall, i in PLACES)
        return hashlib.sha256(b"".join(pictures)).hexdigest()

    assert fingerprint() == fingerprint()


@pytest.mark.parametrize(("wall", "segment"), PLACES[::5])
def test_a_picture_is_as_large_as_its_wall(wall, segment: int):
    picture = wall_picture(WORLD, wall, segment)
    assert picture.dtype == np.uint8
    assert picture.shape[0] == round(WORLD.height_m * TEXELS_PER_M)
    assert picture.shape[1] == pytest.approx(wall.lengths[segment] * TEXELS_PER_M, abs=1)


@pytest.mark.parametrize("kind", get_args(Material))
def test_materials_have_structure_but_no_noise(kind: str):
    tile, size_m = flat_tile(Texture(kind=kind, rgb=(160, 140, 120), accent=(90, 80, 70)))
    grey = tile.astype(float).mean(axis=2)
    assert tile.shape == (round(size_m * TEXELS_PER_M),) * 2 + (3,)
    assert grey.std() > 4
    # Neighbouring texels mostly agree: it survives being looked at in a 50x75 image.
    assert np.mean(np.abs(np.diff(grey, axis=1)) < 3) > 0.6


def test_floor_and_ceiling_tiles_repeat_seamlessly_over_whole_tiles():
    for surface in (WORLD.floor, WORLD.ceiling):
        tile, size_m = flat_tile(WORLD.textures[surface.texture])
        assert (size_m * TEXELS_PER_M) % 1 < 0.5
        assert tile.shape[0] == tile.shape[1]


def test_walls_of_different_arms_look_different():
    """Eye-level rows of the four end walls of the boundary, squeezed to equal length."""
    ends = [wall_picture(WORLD, WORLD.walls[0], i) for i in (0, 3, 6, 9)]
    for a, b in itertools.combinations(ends, 2):
        lower = slice(-TEXELS_PER_M, None)
        assert np.abs(a[lower].astype(float) - b[lower].astype(float)).mean() > 15


def test_a_fixture_stands_where_the_map_says():
    """Seen from the free side a segment runs from right to left."""
    tree = WORLD.model_dump()
    tree["fixtures"] = []
    bare = wall_picture(World.model_validate(tree), WORLD.walls[0], 0).astype(int)
    door = WORLD.fixtures[0].model_dump()
    tree["fixtures"] = [door]
    changed = np.abs(wall_picture(World.model_validate(tree), WORLD.walls[0], 0) - bare).sum(2) > 0
    columns = np.flatnonzero(changed.any(axis=0)) / TEXELS_PER_M
    rows = np.flatnonzero(changed.any(axis=1)) / TEXELS_PER_M
    left = WORLD.walls[0].lengths[0] - door["at_m"] - door["width_m"] / 2
    assert columns.min() == pytest.approx(left, abs=0.05)
    assert columns.max() == pytest.approx(left + door["width_m"], abs=0.05)
    assert rows.min() == pytest.approx(WORLD.height_m - door["height_m"], abs=0.05)


def test_light_depends_on_the_direction_of_the_wall():
    tree = WORLD.model_dump()
    tree["fixtures"] = []
    for wall in tree["walls"]:
        wall["textures"] = ["cream"]
    world = World.model_validate(tree)
    means = [wall_picture(world, world.walls[0], i)[:, 20:36].mean() for i in (0, 3, 6, 9)]
    assert len({round(mean) for mean in means}) == 4


def with_fixture(segment: int, **fixture: object) -> World:
    """Plus with one fixture only, in the middle of a segment of its boundary."""
    tree = WORLD.model_dump()
    at = {"wall": "outer", "segment": segment, "at_m": 3.1, "width_m": 1.4, "rgb": (40, 90, 140)}
    tree["fixtures"] = [{**at, "height_m": 2.2, **fixture}]
    return World.model_validate(tree)


def test_glazing_is_as_bright_on_a_dark_wall_as_on_a_bright_one():
    means = []
    for segment in (0, 6):
        world = with_fixture(segment, kind="glazing")
        picture = wall_picture(world, world.walls[0], segment)
        middle = round(3.1 * TEXELS_PER_M)
        means.append(picture[20:70, middle - 18 : middle + 18].mean())
    assert means[0] == pytest.approx(means[1], abs=1.0)
    assert means[0] > 190


def test_doors_of_each_style_look_different_even_in_one_colour():
    pictures = []
    for style in get_args(DoorStyle):
        world = with_fixture(0, kind="door", style=style)
        pictures.append(wall_picture(world, world.walls[0], 0).astype(float).mean(axis=2))
    for a, b in itertools.combinations(pictures, 2):
        changed = np.abs(a - b) > 10
        assert changed.sum() > 0.05 * 1.4 * 2.2 * TEXELS_PER_M**2
