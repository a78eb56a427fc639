"""Worlds as data: a TOML file in `worlds/` read into typed, checked, immutable objects.

A world is a set of closed wall loops with free space on their left: first the boundary, which runs
anticlockwise, then islands, which run clockwise. Every wall segment has a texture; fixtures (doors,
windows, notice boards, radiators) are painted onto segments. Obstacles are boxes that stand in it.
Units are metres and degrees, x to the right and y up on the map.
"""

import hashlib
import math
import tomllib
from collections.abc import Collection
from functools import cached_property
from pathlib import Path
from typing import Annotated, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationError, ValidationInfo, field_validator, model_validator

from services.robot_driver.simulated.world_parts import (
    Fixture,
    Floats,
    Lap,
    Length,
    Obstacle,
    Part,
    Route,
    Start,
    Surface,
    Text,
    Texture,
    Wall,
    inside,
)
from shared import plugins
from shared.errors import ConfigError, first_problem, meant
from shared.messages import Box

WORLDS = Path(__file__).parent / "worlds"
"""Folder of the worlds that come with the driver."""
OWN_WORLDS = Path("worlds")
"""Folder of a user's own worlds, seen from the working directory."""
MAX_OBSTACLES = 64
"""More boxes than this do not stand in a world at the same time."""
_POINTS_AT_ONCE = 8192
"""Points against all walls at a time: bounds the memory of looking at a whole grid."""


class WorldError(ConfigError):
    """A world file cannot be used; the message is one line naming file and key."""


class World(Part):
    """One corridor (A3)."""

    name: Text
    title: Annotated[str, Field(min_length=1, max_length=200)]
    height_m: Length
    floor: Surface
    ceiling: Surface
    textures: dict[Text, Texture]
    walls: Annotated[tuple[Wall, ...], Field(min_length=1, strict=False)]
    fixtures: Annotated[tuple[Fixture, ...], Field(strict=False)] = ()
    starts: Annotated[tuple[Start, ...], Field(min_length=1, strict=False)]
    lap: Lap | None = None
    route: Route | None = None
    obstacles: Annotated[tuple[Obstacle, ...], Field(max_length=MAX_OBSTACLES, strict=False)] = ()
    """Boxes that stand there from the beginning."""

    @field_validator("walls", "obstacles")
    @classmethod
    def _named_once(
        cls, parts: tuple[Wall | Obstacle, ...], info: ValidationInfo
    ) -> tuple[Wall | Obstacle, ...]:
        names = [part.name for part in parts]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"two {info.field_name} are named {twice[0]!r}")
        return parts

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        self._check_loops()
        self._check_textures()
        for i, fixture in enumerate(self.fixtures):
            self._check_fixture(f"fixtures.{i}", fixture)
        for i, obstacle in enumerate(self.obstacles):
            try:
                self.check_obstacle(obstacle)
            except ValueError as error:
                raise ValueError(f"obstacles.{i}: {error}") from None
        for i, start in enumerate(self.starts):
            if not self.free(np.array([[start.x_m, start.y_m]]))[0]:
                raise ValueError(f"starts.{i}: ({start.x_m}, {start.y_m}) is not in free space")
        if self.lap is not None and self.between_walls(np.array([self.lap.centre]))[0]:
            raise ValueError("lap.centre: a robot could drive over it; put it on an island")
        if self.route is not None:
            self._check_route(self.route)
        return self

    def _check_loops(self) -> None:
        """Exactly one boundary, and it comes first; islands run the other way round."""
        for i, wall in enumerate(self.walls):
            if (wall.area_m2 > 0.0) != (i == 0):
                way = "anticlockwise" if i == 0 else "clockwise (the first wall is the boundary)"
                raise ValueError(f"walls.{i}: points must run {way}")

    def _check_textures(self) -> None:
        used = [("floor.texture", self.floor.texture), ("ceiling.texture", self.ceiling.texture)]
        used += [
            (f"walls.{i}.textures.{k}", name)
            for i, wall in enumerate(self.walls)
            for k, name in enumerate(wall.textures)
        ]
        for key, name in used:
            if name not in self.textures:
                raise ValueError(f"{key}: no texture named {name!r}")

    def _check_fixture(self, key: str, fixture: Fixture) -> None:
        wall = next((wall for wall in self.walls if wall.name == fixture.wall), None)
        if wall is None:
            raise ValueError(f"{key}.wall: no wall named {fixture.wall!r}")
        if fixture.segment >= len(wall.points):
            raise ValueError(f"{key}.segment: {fixture.wall!r} has {len(wall.points)} segments")
        room = float(wall.lengths[fixture.segment])
        half = fixture.width_m / 2
        if fixture.at_m < half or fixture.at_m + half > room:
            raise ValueError(f"{key}.at_m: does not fit onto a segment of {room:.2f} m")
        if fixture.bottom_m + fixture.height_m > self.height_m:
            raise ValueError(f"{key}.height_m: higher than the wall ({self.height_m} m)")

    def _check_route(self, route: Route) -> None:
        """Check that it lies on free space. It may cross itself and pass through obstacles."""
        places = {"route.points": route.sample(0.05)}
        for i, place in enumerate(route.places):
            places[f"route.places.{i}"] = np.array([[place.x_m, place.y_m]])
        for key, points in places.items():
            outside = points[~self.between_walls(points)]
            if len(outside):
                x, y = outside[0]
                raise ValueError(f"{key}: ({x:g}, {y:g}) is not in free space")
        names = [place.name for place in route.places]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"route.places: two are named {twice[0]!r}")

    def check_placing(self, obstacle: Obstacle, there: Collection[str]) -> None:
        """Whether a box can be placed beside those of these names. Raises ValueError."""
        if obstacle.name in there:
            raise ValueError(f"there is already an obstacle {obstacle.name!r}")
        if len(there) >= MAX_OBSTACLES:
            raise ValueError(f"there are {MAX_OBSTACLES} obstacles already")
        self.check_obstacle(obstacle)

    def check_start(self, start: int) -> None:
        """Whether there is a start pose of this number. Raises ValueError."""
        if not 0 <= start < len(self.starts):
            raise ValueError(
                f"world {self.name!r}: expected a start from 0 to {len(self.starts) - 1}, "
                f"got {start}"
            )

    def check_obstacle(self, obstacle: Obstacle) -> None:
        """Whether a box can stand in this world; it may touch or reach into walls.

        Raises ValueError: it reaches beyond the outermost walls or through the ceiling.
        """
        x0, y0, x1, y1 = self.bounds
        slack = 1e-6  # of a box turned against a wall
        low, high = obstacle.corners.min(axis=0), obstacle.corners.max(axis=0)
        if bool(np.any(low < (x0 - slack, y0 - slack)) or np.any(high > (x1 + slack, y1 + slack))):
            raise ValueError(
                f"obstacle {obstacle.name!r}: expected x {x0:g}..{x1:g}, y {y0:g}..{y1:g}, "
                f"got x {low[0]:g}..{high[0]:g}, y {low[1]:g}..{high[1]:g}"
            )
        if obstacle.height_m > self.height_m:
            raise ValueError(
                f"obstacle {obstacle.name!r}: height_m {obstacle.height_m:g} is higher than "
                f"the walls ({self.height_m:g} m)"
            )

    @property
    def segments(self) -> Floats:
        """float64 [n, 4] of all walls: start x, y, end x, y; free space on the left."""
        return np.vstack([wall.segments for wall in self.walls])

    @property
    def solid_segments(self) -> Floats:
        """float64 [n, 4] of all walls and obstacles, as `segments`."""
        return np.vstack([self.segments, *(obstacle.segments for obstacle in self.obstacles)])

    @cached_property
    def fingerprint(self) -> str:
        """16 hex digits over everything in the file."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:16]

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Smallest x, y, largest x, y of all walls."""
        xy = self.segments.reshape(-1, 2)
        low, high = xy.min(axis=0), xy.max(axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def between_walls(self, points: Floats) -> npt.NDArray[np.bool_]:
        """Whether points float64 [n, 2] lie inside the boundary and off islands."""
        return inside(self.segments, points)

    def free(self, points: Floats) -> npt.NDArray[np.bool_]:
        """Whether points float64 [n, 2] lie between the walls and in no obstacle."""
        free = self.between_walls(points)
        for obstacle in self.obstacles:
            free &= ~obstacle.contains(points)
        return free

    def distance(self, points: Floats) -> Floats:
        """Distance of points float64 [n, 2] to the nearest wall or obstacle, float64 [n]."""
        parts = range(0, max(len(points), 1), _POINTS_AT_ONCE)
        return np.concatenate([self._distance(points[i : i + _POINTS_AT_ONCE]) for i in parts])

    def _distance(self, points: Floats) -> Floats:
        start, end = np.hsplit(self.solid_segments, 2)
        along = end - start
        length2 = np.einsum("ij,ij->i", along, along)
        offset = points[:, None, :] - start
        t = np.clip(np.einsum("nsj,sj->ns", offset, along) / length2, 0.0, 1.0)
        gap = offset - t[..., None] * along
        return np.asarray(np.sqrt(np.einsum("nsj,nsj->ns", gap, gap).min(axis=1)))

    def clearance(self, points: Floats) -> Floats:
        """As `distance`, but negative off free space."""
        distance = self.distance(points)
        return np.where(self.free(points), distance, -distance)

    def sight(self, points: Floats, headings_rad: Floats) -> Floats:
        """How far one sees from points float64 [n, 2] in given directions [n]; inf if for ever."""
        start, end = np.hsplit(self.solid_segments, 2)
        along = end - start
        look = np.column_stack([np.cos(headings_rad), np.sin(headings_rad)])[:, None, :]
        offset = start - points[:, None, :]
        cross = look[..., 0] * along[:, 1] - look[..., 1] * along[:, 0]
        meets = np.abs(cross) > 1e-9  # else parallel
        cross = np.where(meets, cross, 1.0)
        far = (offset[..., 0] * along[:, 1] - offset[..., 1] * along[:, 0]) / cross
        part = (offset[..., 0] * look[..., 1] - offset[..., 1] * look[..., 0]) / cross
        hit = meets & (part > -1e-9) & (part < 1.0 + 1e-9) & (far > 1e-9)
        return np.asarray(np.where(hit, far, np.inf).min(axis=1))


def world_files() -> dict[str, Path]:
    """All worlds by name: those that come with the driver, then those in the user's `worlds/`.

    Raises WorldError: one in `worlds/` has a name that is taken.
    """
    files = {path.stem: path for path in sorted(WORLDS.glob("*.toml"))}
    for path in sorted(OWN_WORLDS.glob("*.toml")):
        if path.stem in files:
            raise WorldError(f"{path}: a world named {path.stem!r} comes along; rename this one")
        files[path.stem] = path
    return files


def world_path(name: str) -> Path:
    """The file of a world, given by name or, ending in `.toml`, by path. Raises WorldError."""
    if name.endswith(".toml"):
        return Path(name)
    files = world_files()
    if name in files:
        return files[name]
    try:
        return Path(plugins.load(plugins.WORLDS, name))
    except KeyError:
        known = (*files, *plugins.names(plugins.WORLDS))
        there = f"{', '.join(known)}{meant(name, known)}"
        raise WorldError(f"no world named {name!r}; there are: {there}") from None


def load_world(name: str) -> World:
    """The world of that name: one that comes along, one in `worlds/`, or another package's.

    Raises WorldError: there is none of that name, or its file is wrong.
    """
    return read_world(world_path(name))


def solids(name: str) -> list[Box]:
    """The walls and boxes of a world, for pictures of it; none where it cannot be read."""
    try:
        world = load_world(name)
    except WorldError:
        return []
    found = [Box.model_validate(obstacle.model_dump()) for obstacle in world.obstacles]
    for wall in world.walls:
        for i, (ax, ay, bx, by) in enumerate(wall.segments.tolist()):
            side = {"x_m": (ax + bx) / 2, "y_m": (ay + by) / 2, "width_m": 0.02}
            side |= {"heading_deg": math.degrees(math.atan2(by - ay, bx - ax))}
            side |= {"length_m": float(wall.lengths[i]), "height_m": world.height_m}
            rgb = world.textures[wall.texture_of(i)].rgb
            found.append(Box.model_validate({"name": f"{wall.name}-{i}", "rgb": rgb, **side}))
    return found


def read_world(path: Path) -> World:
    """Read and check one world file. Raises WorldError: one line with file, key, what is wrong."""
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise WorldError(f"{path.name}: {error}") from error
    try:
        world = World.model_validate(tree)
    except ValidationError as error:
        raise WorldError(f"{path.name}: {first_problem(error)}") from error
    if world.name != path.stem:
        raise WorldError(f"{path.name}: name: {world.name!r} does not match the file name")
    return world
