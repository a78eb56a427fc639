"""Pictures of walls, floor and ceiling, painted from a world's data: equal data, equal pixels.

Everything is drawn at four times the final resolution and averaged down, because the renderer
takes the nearest texel: what is finer than a texel would flicker in a 50x75 image.
Light is painted in: walls are brighter or darker by direction, and darker towards their edges.
"""

import itertools
import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from services.robot_driver.simulated.world import World
from services.robot_driver.simulated.world_parts import Colour, Fixture, Texture, Wall

Picture = npt.NDArray[np.uint8]
"""uint8 [h, w, 3], RGB, first row at the top."""
Canvas = npt.NDArray[np.float32]
"""float32 [h, w, 3], RGB from 0 to 255, at drawing resolution."""
Box = tuple[float, float, float, float]
"""Left, bottom, width, height in metres."""

TEXELS_PER_M = 32
_OVERSAMPLING = 4
_DRAW = TEXELS_PER_M * _OVERSAMPLING
"""Pixels per metre while drawing."""
_TILE_M = 1.2
"""Size of the square that floors and ceilings repeat."""


def wall_picture(world: World, wall: Wall, segment: int) -> Picture:
    """One wall segment seen from the free side, fixtures and light included.

    The segment runs from right to left in it, because free space is on its left.
    """
    length = float(wall.lengths[segment])
    texture = world.textures[wall.texture_of(segment)]
    canvas = _blank(length, world.height_m, texture.rgb)
    _MATERIALS[texture.kind](canvas, texture)
    here = [f for f in world.fixtures if f.wall == wall.name and f.segment == segment]
    ax, ay, bx, by = wall.segments[segment]
    for luminous in (False, True):  # what has light of its own is not dimmed by that of the wall
        for fixture in here:
            if (fixture.kind in _LUMINOUS) == luminous:
                _FIXTURES[fixture.kind](canvas, fixture, _place(fixture, length))
        if not luminous:
            _light(canvas, math.atan2(by - ay, bx - ax))
    return _finish(canvas)


def flat_tile(texture: Texture) -> tuple[Picture, float]:
    """The square that floor or ceiling repeats, and its size in metres."""
    canvas = _blank(_TILE_M, _TILE_M, texture.rgb)
    _MATERIALS[texture.kind](canvas, texture)
    return _finish(canvas), _TILE_M


def box_picture(length_m: float, height_m: float, rgb: Colour, angle_rad: float) -> Picture:
    """One side of a box of one colour, lit like a wall whose segment has this direction."""
    canvas = _blank(length_m, height_m, rgb)
    _light(canvas, angle_rad)
    return _finish(canvas)


def _blank(width_m: float, height_m: float, rgb: Colour) -> Canvas:
    shape = (_texels(height_m) * _OVERSAMPLING, _texels(width_m) * _OVERSAMPLING, 3)
    return np.full(shape, rgb, np.float32)


def _texels(length_m: float) -> int:
    return max(1, round(length_m * TEXELS_PER_M))


def _finish(canvas: Canvas) -> Picture:
    h, w = canvas.shape[0] // _OVERSAMPLING, canvas.shape[1] // _OVERSAMPLING
    small = canvas.reshape(h, _OVERSAMPLING, w, _OVERSAMPLING, 3).mean(axis=(1, 3))
    return np.asarray(np.clip(np.rint(small), 0, 255), np.uint8)


def _light(canvas: Canvas, angle_rad: float) -> None:
    """Darken by direction of the wall, and towards floor, ceiling and both ends."""
    canvas *= 0.86 + 0.14 * math.cos(angle_rad - math.radians(65.0))
    h, w = canvas.shape[:2]
    x = np.minimum(np.arange(w), np.arange(w)[::-1]) / _DRAW
    y = np.minimum(np.arange(h), np.arange(h)[::-1]) / _DRAW
    for distance, shape in ((x, (1, w, 1)), (y, (h, 1, 1))):
        canvas *= (1.0 - 0.22 * np.exp(-distance / 0.15)).astype(np.float32).reshape(shape)


def _box(canvas: Canvas, x: float, y: float, width: float, height: float, rgb: Colour) -> None:
    """Fill a rectangle; metres from the left and from the floor."""
    h = canvas.shape[0]
    top, bottom = h - round((y + height) * _DRAW), h - round(y * _DRAW)
    left, right = round(x * _DRAW), round((x + width) * _DRAW)
    canvas[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = rgb


def _mix(rgb: Colour, factor: float) -> Colour:
    """A brighter (above 1) or darker colour."""
    r, g, b = (min(255, round(channel * factor)) for channel in rgb)
    return r, g, b


def _variation(row: int, column: int) -> float:
    """A fixed pseudo-random number in -1..1 for one brick, board or panel."""
    mixed = (row * 73856093) ^ (column * 19349663)
    return ((mixed * 2654435761) % 2**32) / 2**31 - 1.0


def _plaster(canvas: Canvas, texture: Texture) -> None:
    """Two-tone paint with dado rail and skirting board."""
    h, w = canvas.shape[:2]
    width = w / _DRAW
    _box(canvas, 0.0, 0.0, width, 0.95, texture.accent)
    _box(canvas, 0.0, 0.95, width, 0.07, _mix(texture.accent, 0.6))
    _box(canvas, 0.0, 0.0, width, 0.12, _mix(texture.accent, 0.45))
    _box(canvas, 0.0, h / _DRAW - 0.08, width, 0.08, _mix(texture.rgb, 1.08))


def _brick(canvas: Canvas, texture: Texture) -> None:
    """Running bond of large bricks with joints in the accent colour, dark skirting board."""
    h, w = canvas.shape[:2]
    canvas[:] = texture.accent
    length, course, joint = 0.40, 0.16, 0.025
    for row in range(math.ceil(h / _DRAW / course)):
        shift = length / 2 * (row % 2)
        for column in range(-1, math.ceil(w / _DRAW / length) + 1):
            rgb = _mix(texture.rgb, 1.0 + 0.08 * _variation(row, column))
            x, y = column * length + shift, row * course
            if x + length > 0:
                _box(canvas, max(x, 0.0), y, length - joint + min(x, 0.0), course - joint, rgb)
    _box(canvas, 0.0, 0.0, w / _DRAW, 0.12, _mix(texture.rgb, 0.4))


def _panelling(canvas: Canvas, texture: Texture) -> None:
    """Wooden boards with dark grooves up to 1.2 m, a cap rail, painted wall above."""
    w = canvas.shape[1] / _DRAW
    top, board = 1.2, 0.2
    canvas[:] = _mix((226, 216, 198), 1.0)
    for column in range(math.ceil(w / board)):
        _box(
            canvas, column * board, 0.0, board, top,
            _mix(texture.rgb, 1.0 + 0.1 * _variation(1, column)),
        )  # fmt: skip
        _box(canvas, column * board, 0.0, 0.03, top, texture.accent)
    _box(canvas, 0.0, top, w, 0.08, texture.accent)
    _box(canvas, 0.0, 0.0, w, 0.15, _mix(texture.accent, 0.8))


def _tiles(canvas: Canvas, texture: Texture) -> None:
    """Square floor tiles in two close shades."""
    size = 0.6
    for row in range(round(canvas.shape[0] / _DRAW / size)):
        for column in range(round(canvas.shape[1] / _DRAW / size)):
            rgb = texture.rgb if (row + column) % 2 else texture.accent
            _box(canvas, column * size, row * size, size, size, rgb)


def _panels(canvas: Canvas, texture: Texture) -> None:
    """Ceiling panels with a lamp in one of four."""
    size, joint = 0.6, 0.04
    w = canvas.shape[1] / _DRAW
    for i in range(round(w / size)):
        _box(canvas, i * size, 0.0, joint, w, texture.accent)
        _box(canvas, 0.0, i * size, w, joint, texture.accent)
    _box(canvas, joint * 2, joint * 2, size - joint * 3, size - joint * 3, (255, 255, 246))


def _stripes(canvas: Canvas, texture: Texture) -> None:
    """Wallpaper of broad and narrow vertical stripes between skirting board and picture rail."""
    w, h = canvas.shape[1] / _DRAW, canvas.shape[0] / _DRAW
    step = 0.5
    for column in range(math.ceil(w / step)):
        _box(canvas, column * step, 0.0, 0.2, h, texture.accent)
        _box(canvas, column * step + 0.28, 0.0, 0.05, h, _mix(texture.accent, 0.7))
    _box(canvas, 0.0, 0.0, w, 0.22, (240, 238, 230))
    _box(canvas, 0.0, h - 0.3, w, 0.07, (240, 238, 230))


def _mosaic(canvas: Canvas, texture: Texture) -> None:
    """Chequered wall tiles up to 1.5 m, a border of the accent colour, plain wall above."""
    w = canvas.shape[1] / _DRAW
    size, rows = 0.25, 6
    canvas[:] = _mix(texture.rgb, 1.2)
    for row in range(rows):
        for column in range(math.ceil(w / size)):
            rgb = texture.rgb if (row + column) % 2 else texture.accent
            rgb = _mix(rgb, 1.0 + 0.06 * _variation(row, column))
            _box(canvas, column * size, row * size, size, size, rgb)
    _box(canvas, 0.0, rows * size, w, 0.1, _mix(texture.accent, 0.6))


def _concrete(canvas: Canvas, texture: Texture) -> None:
    """Cast slabs, two high, with joints and the round marks of the formwork."""
    w, h = canvas.shape[1] / _DRAW, canvas.shape[0] / _DRAW
    long, tall, joint = 1.25, h / 2, 0.05
    for row in range(2):
        for column in range(math.ceil(w / long)):
            x, y = column * long, row * tall
            rgb = _mix(texture.rgb, 1.0 + 0.1 * _variation(row + 5, column))
            _box(canvas, x, y, long, tall, texture.accent)
            _box(canvas, x + joint, y + joint, long - joint, tall - joint, rgb)
            for u, v in itertools.product((0.25, 0.75), repeat=2):
                _box(canvas, x + u * long, y + v * tall, 0.09, 0.09, texture.accent)


def _planks(canvas: Canvas, texture: Texture) -> None:
    """Floor boards with dark joints, laid in four courses that are shifted against each other."""
    size = canvas.shape[0] / _DRAW
    wide = size / 4
    for row in range(4):
        _box(canvas, 0.0, row * wide, size, wide, _mix(texture.rgb, 1.0 + 0.08 * (row % 3 - 1)))
        _box(canvas, 0.0, row * wide, size, 0.03, texture.accent)
        _box(canvas, size * (row * 2 % 4) / 4, row * wide, 0.03, wide, texture.accent)


def _strip_light(canvas: Canvas, texture: Texture) -> None:
    """Plain ceiling with one long lamp in a dark trough."""
    size = canvas.shape[0] / _DRAW
    _box(canvas, 0.15, size * 0.4, size - 0.3, 0.24, texture.accent)
    _box(canvas, 0.2, size * 0.4 + 0.06, size - 0.4, 0.12, (255, 255, 250))


def _door(canvas: Canvas, fixture: Fixture, place: Box) -> None:
    """Frame, leaf in one of three styles, handle."""
    x, y, w, h = place
    _box(canvas, x, y, w, h, _mix(fixture.rgb, 0.45))
    _box(canvas, x + 0.07, y, w - 0.14, h - 0.07, fixture.rgb)
    _LEAVES[fixture.style or "panelled"](canvas, fixture, (x + 0.07, y, w - 0.14, h - 0.07))
    _box(canvas, x + w - 0.2, y + 1.0, 0.12, 0.05, (220, 220, 210))


def _panelled_leaf(canvas: Canvas, fixture: Fixture, leaf: Box) -> None:
    """Two fields, one above the other."""
    x, y, w, h = leaf
    for bottom, tall in ((0.2, 0.65), (1.15, h - 1.38)):
        if tall > 0:
            _box(canvas, x + 0.13, y + bottom, w - 0.26, tall, _mix(fixture.rgb, 0.8))


def _flush_leaf(canvas: Canvas, fixture: Fixture, leaf: Box) -> None:
    """Smooth, with a kick plate and a narrow pane above the handle."""
    x, y, w, _ = leaf
    _box(canvas, x + 0.05, y + 0.05, w - 0.1, 0.2, (176, 178, 180))
    _box(canvas, x + w - 0.3, y + 1.15, 0.12, 0.6, (206, 220, 226))
    _box(canvas, x, y + 0.6, w, 0.05, _mix(fixture.rgb, 0.75))


def _chevron_leaf(canvas: Canvas, fixture: Fixture, leaf: Box) -> None:
    """Bands that rise towards the middle, in the door's colour and white."""
    del fixture
    x, y, w, h = (round(length * _DRAW) for length in leaf)
    bottom = canvas.shape[0] - y
    part = canvas[bottom - h : bottom, x : x + w]
    rows, columns = np.mgrid[0 : part.shape[0], 0 : part.shape[1]]
    rise = np.abs(columns - part.shape[1] / 2)
    part[((rows - rise) // (0.2 * _DRAW)) % 2 == 0] = (248, 248, 244)


def _window(canvas: Canvas, fixture: Fixture, place: Box) -> None:
    """Panes with sky, frame, sill."""
    x, y, w, h = place
    _box(canvas, x - 0.05, y - 0.06, w + 0.1, h + 0.06, fixture.rgb)
    for k in range(8):
        _box(canvas, x, y + h * k / 8, w, h / 8, (170 + 8 * k, 200 + 5 * k, 225 + 3 * k))
    for k in range(3):
        _box(canvas, x + (w - 0.06) * k / 2, y, 0.06, h, fixture.rgb)
    _box(canvas, x, y + h - 0.06, w, 0.06, fixture.rgb)
    _box(canvas, x - 0.05, y - 0.06, w + 0.1, 0.06, _mix(fixture.rgb, 0.7))


def _glazing(canvas: Canvas, fixture: Fixture, place: Box) -> None:
    """A glass front with daylight behind it: brightest overhead, between dark mullions."""
    x, y, w, h = place
    _box(canvas, x, y, w, h, fixture.rgb)
    panes = max(1, round(w / 0.9))
    wide = w / panes
    for k, band in itertools.product(range(panes), range(12)):
        light = band / 11
        rgb = (round(206 + 49 * light), round(220 + 35 * light), round(232 + 20 * light))
        _box(canvas, x + k * wide + 0.05, y + 0.06 + (h - 0.12) * band / 12,
             wide - 0.1, (h - 0.12) / 12, rgb)  # fmt: skip
    _box(canvas, x, y + h * 0.3, w, 0.06, fixture.rgb)


def _board(canvas: Canvas, fixture: Fixture, place: Box) -> None:
    """Notice board with sheets of paper."""
    x, y, w, h = place
    _box(canvas, x, y, w, h, _mix(fixture.rgb, 0.5))
    _box(canvas, x + 0.04, y + 0.04, w - 0.08, h - 0.08, fixture.rgb)
    columns = max(1, int((w - 0.1) / 0.3))
    for k in range(columns):
        tall = 0.3 + 0.08 * _variation(3, k)
        left = x + (w - 0.1) * (k + 0.5) / columns - 0.05
        _box(canvas, left, y + h - tall - 0.12, 0.2, tall, (244, 242, 232))


def _radiator(canvas: Canvas, fixture: Fixture, place: Box) -> None:
    """Ribs with dark gaps."""
    x, y, w, h = place
    _box(canvas, x, y, w, h, _mix(fixture.rgb, 0.65))
    ribs = max(1, round(w / 0.2))
    for k in range(ribs):
        _box(canvas, x + w * k / ribs, y, w / ribs * 0.66, h, fixture.rgb)
    _box(canvas, x, y + h - 0.05, w, 0.05, fixture.rgb)


def _place(fixture: Fixture, length: float) -> Box:
    """Left, bottom, width, height in the picture, where the segment runs from right to left."""
    left = length - fixture.at_m - fixture.width_m / 2
    return left, fixture.bottom_m, fixture.width_m, fixture.height_m


_MATERIALS: dict[str, Callable[[Canvas, Texture], None]] = {
    "plaster": _plaster,
    "brick": _brick,
    "panelling": _panelling,
    "tiles": _tiles,
    "panels": _panels,
    "stripes": _stripes,
    "mosaic": _mosaic,
    "concrete": _concrete,
    "planks": _planks,
    "strip-light": _strip_light,
}
_FIXTURES: dict[str, Callable[[Canvas, Fixture, Box], None]] = {
    "door": _door,
    "window": _window,
    "glazing": _glazing,
    "board": _board,
    "radiator": _radiator,
}
_LUMINOUS = ("glazing",)
"""Fixtures with light of their own."""
_LEAVES: dict[str, Callable[[Canvas, Fixture, Box], None]] = {
    "panelled": _panelled_leaf,
    "flush": _flush_leaf,
    "chevron": _chevron_leaf,
}
