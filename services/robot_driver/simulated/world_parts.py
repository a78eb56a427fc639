"""The parts of a world: walls, fixtures, obstacles, starts, route; typed, checked, immutable.

Units are metres and degrees, x to the right and y up on the map.
"""

import math
from typing import Annotated, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator

from shared.facts import NAME

Floats = npt.NDArray[np.float64]
Text = Annotated[str, Field(pattern=NAME.pattern)]
Length = Annotated[float, Field(gt=0.0, le=100.0)]
Side = Annotated[float, Field(ge=0.01, le=100.0)]
Coordinate = Annotated[float, Field(ge=-1000.0, le=1000.0)]
Point = Annotated[tuple[Coordinate, Coordinate], Field(strict=False)]
Channel = Annotated[int, Field(ge=0, le=255)]
Colour = Annotated[tuple[Channel, Channel, Channel], Field(strict=False)]
"""Red, green, blue."""
Material = Literal[
    "plaster", "brick", "panelling", "stripes", "mosaic", "concrete",
    "tiles", "planks", "panels", "strip-light",
]  # fmt: skip
"""Six for walls, two for floors, two for ceilings; any may be used anywhere."""
PlaceKind = Literal["dead-end", "bridge", "junction", "window", "door", "obstacle", "corridor"]
FixtureKind = Literal["door", "window", "glazing", "board", "radiator"]
DoorStyle = Literal["panelled", "flush", "chevron"]


def inside(segments: Floats, points: Floats) -> npt.NDArray[np.bool_]:
    """Whether points float64 [n, 2] lie in loops of segments float64 [s, 4], and off islands."""
    x, y = points[:, 0, None], points[:, 1, None]
    ax, ay, bx, by = segments.T[:, None, :]
    spans = (ay > y) != (by > y)
    rise = np.where(by == ay, 1.0, by - ay)
    crosses = spans & (x < ax + (y - ay) / rise * (bx - ax))
    return np.asarray(np.count_nonzero(crosses, axis=1) % 2 == 1)


class Part(BaseModel):
    """Base of all parts of a world: frozen, strict, unknown keys refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Texture(Part):
    """How a surface looks; painted by `textures`."""

    kind: Material
    rgb: Colour
    """Main colour; for plaster the wall above the dado rail."""
    accent: Colour = (96, 96, 96)
    """Second colour: dado, mortar, joints."""


class Surface(Part):
    """Floor or ceiling."""

    texture: Text


class Wall(Part):
    """A closed loop of wall segments; segment i runs from point i to the next, free on its left."""

    name: Text
    points: Annotated[tuple[Point, ...], Field(min_length=3, max_length=256, strict=False)]
    textures: Annotated[tuple[Text, ...], Field(min_length=1, strict=False)]
    """One per segment, or a single one for all."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if len(self.textures) not in (1, len(self.points)):
            raise ValueError(
                f"expected 1 or {len(self.points)} textures, one per segment, "
                f"got {len(self.textures)}"
            )
        if bool(np.any(self.lengths < 0.01)):
            raise ValueError("two neighbouring points are the same")
        return self

    @property
    def segments(self) -> Floats:
        """float64 [n, 4]: start x, y, end x, y."""
        points = np.array(self.points, np.float64)
        return np.hstack([points, np.roll(points, -1, axis=0)])

    @property
    def lengths(self) -> Floats:
        """float64 [n], metres."""
        s = self.segments
        return np.hypot(s[:, 2] - s[:, 0], s[:, 3] - s[:, 1])

    @property
    def area_m2(self) -> float:
        """Enclosed area, negative if the points run clockwise."""
        ax, ay, bx, by = self.segments.T
        return float(np.sum(ax * by - bx * ay)) / 2.0

    def texture_of(self, segment: int) -> str:
        """Name of the texture of one segment."""
        return self.textures[segment if len(self.textures) > 1 else 0]


class Fixture(Part):
    """Something on a wall, painted, not solid beyond it."""

    wall: Text
    segment: Annotated[int, Field(ge=0)]
    kind: FixtureKind
    at_m: Annotated[float, Field(ge=0.0)]
    """Distance of its middle from the start of the segment."""
    width_m: Length
    height_m: Length
    bottom_m: Annotated[float, Field(ge=0.0)] = 0.0
    """Height of its lower edge above the floor."""
    rgb: Colour
    style: DoorStyle | None = None
    """Style of a door, panelled unless given."""
    name: Text | None = None
    """Stands on the map instead of the kind."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.kind != "door" and self.style is not None:
            raise ValueError(f"style: only doors have one, this is a {self.kind}")
        return self

    @property
    def look(self) -> tuple[str, str, Colour]:
        """What tells it from others: kind, style, colour."""
        return self.kind, self.style or "panelled", self.rgb


class Obstacle(Part):
    """A box standing on the floor: solid, and seen from its sides and from above."""

    name: Text
    x_m: Coordinate
    """Place of its middle."""
    y_m: Coordinate
    heading_deg: Annotated[float, Field(ge=-360.0, le=360.0)] = 0.0
    """Direction along which `length_m` is measured."""
    length_m: Side
    width_m: Side
    height_m: Side
    rgb: Colour

    @property
    def corners(self) -> Floats:
        """float64 [4, 2], anticlockwise."""
        turn = math.radians(self.heading_deg)
        c, s = math.cos(turn), math.sin(turn)
        signs = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        local = signs * (self.length_m / 2, self.width_m / 2)
        return np.asarray(local @ np.array([[c, s], [-s, c]]) + (self.x_m, self.y_m))

    @property
    def segments(self) -> Floats:
        """float64 [4, 4] of its sides: start x, y, end x, y; free space on the left."""
        clockwise = self.corners[::-1]
        return np.hstack([clockwise, np.roll(clockwise, -1, axis=0)])

    def contains(self, points: Floats) -> npt.NDArray[np.bool_]:
        """Whether points float64 [n, 2] lie inside it."""
        turn = math.radians(self.heading_deg)
        x, y = points[:, 0] - self.x_m, points[:, 1] - self.y_m
        along = np.abs(x * math.cos(turn) + y * math.sin(turn))
        across = np.abs(y * math.cos(turn) - x * math.sin(turn))
        return np.asarray((along < self.length_m / 2) & (across < self.width_m / 2))


class Start(Part):
    """A pose from which a robot may start."""

    x_m: Coordinate
    y_m: Coordinate
    heading_deg: Annotated[float, Field(ge=-360.0, le=360.0)]


class Lap(Part):
    """How laps are counted: net angle round `centre`; `line` is only drawn."""

    centre: Point
    line: Annotated[tuple[Point, Point], Field(strict=False)]


class Place(Part):
    """A named place on a route."""

    name: Text
    kind: PlaceKind
    x_m: Coordinate
    y_m: Coordinate


class Route(Part):
    """A full tour of the world, for test drives: how much of it was driven, past which places."""

    points: Annotated[tuple[Point, ...], Field(min_length=2, max_length=256, strict=False)]
    """A line from the first point to the last."""
    places: Annotated[tuple[Place, ...], Field(max_length=64, strict=False)] = ()

    @property
    def length_m(self) -> float:
        """Length of the line."""
        steps = np.diff(np.array(self.points, np.float64), axis=0)
        return float(np.hypot(steps[:, 0], steps[:, 1]).sum())

    def sample(self, spacing_m: float) -> Floats:
        """Points along the line, ends included, at most so far apart; float64 [n, 2]."""
        points = np.array(self.points, np.float64)
        lengths = np.hypot(*np.diff(points, axis=0).T)
        at = np.concatenate([[0.0], np.cumsum(lengths)])
        fine = np.linspace(0.0, at[-1], math.ceil(at[-1] / spacing_m) + 1)
        s = np.union1d(fine, at)
        return np.column_stack([np.interp(s, at, points[:, k]) for k in range(2)])
