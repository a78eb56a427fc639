"""What is wrong with a world though its file can be read: gaps, thin walls, places out of reach.

`corridor world check` prints the result of `problems`. Everything is decided by geometry; nothing
is driven or rendered.
"""

import itertools
import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from services.robot_driver.atlas.action_geometry import CONTACT_M, ActionGeometry
from services.robot_driver.simulated.scene import WALL_THICKNESS_M
from services.robot_driver.simulated.sim import SUBSTEP_M
from services.robot_driver.simulated.world import World
from services.robot_driver.simulated.world_parts import Fixture, Floats, inside

CELL_M = 0.02
"""Grid distance of the search for what can be reached: narrower differences are not seen."""
_TOUCH_M = 1e-6
_SMALL_M2 = 0.05
"""Smaller parts that cannot be reached are corners, not rooms."""


def problems(world: World, geometry: ActionGeometry) -> list[str]:
    """One line for each problem, none if a robot can be let loose in this world.

    Loops that cross are reported alone: without an inside and an outside nothing else has meaning.
    """
    loops = [*_crossings(world), *_misplaced(world)]
    if loops:
        return loops
    return [*_thin_walls(world, geometry), *_unreachable(world, geometry), *_looks(world)]


# ---------------------------------------------------------------- loops


@dataclass(frozen=True)
class _Pairs:
    """Pairs of wall segments that have no corner in common, and where they are closest."""

    first: npt.NDArray[np.int64]
    second: npt.NDArray[np.int64]
    gaps_m: Floats
    """0 where they cross or touch."""
    middles: Floats
    """float64 [n, 2]: half way between the closest points."""


def _named(world: World) -> list[str]:
    """A name for each segment, in the order of `World.segments`."""
    return [f"{wall.name!r} segment {i}" for wall in world.walls for i in range(len(wall.points))]


def _crossings(world: World) -> list[str]:
    """Where walls cross, touch, or run back over themselves: there is a gap, or no wall at all."""
    names, pairs, lines = _named(world), _pairs(world), []
    for i, j, gap, (x, y) in zip(
        pairs.first, pairs.second, pairs.gaps_m, pairs.middles, strict=True
    ):
        if gap < _TOUCH_M:
            lines.append(
                f"walls: {names[i]} and {names[j]} meet at ({x:.2f}, {y:.2f}): "
                "a loop may neither cross nor touch itself or another one"
            )
    for wall in world.walls:
        ways = wall.segments[:, 2:] - wall.segments[:, :2]
        for i, (a, b) in enumerate(zip(ways, np.roll(ways, -1, axis=0), strict=True)):
            if a @ b < 0.0 and abs(a[0] * b[1] - a[1] * b[0]) < _TOUCH_M:
                lines.append(f"walls: {wall.name!r} segment {i}: the next one runs back over it")
    return lines


def _misplaced(world: World) -> list[str]:
    """Islands that do not lie in the corridor, and a lap centre that lies on none."""
    lines = []
    boundary, *islands = world.walls
    for island in islands:
        corner = np.array(island.points[:1], np.float64)
        if not inside(boundary.segments, corner)[0]:
            lines.append(f"walls: island {island.name!r} lies outside the boundary")
        for other in islands:
            if other is not island and inside(other.segments, corner)[0]:
                lines.append(f"walls: island {island.name!r} lies inside {other.name!r}")
    if world.lap is not None:
        centre = np.array([world.lap.centre])
        if not any(inside(island.segments, centre)[0] for island in islands):
            lines.append("lap.centre: lies on no island, so nothing can be driven round")
    return lines


def _pairs(world: World) -> _Pairs:
    segments = world.segments
    first, second = (index[_apart(world)] for index in np.triu_indices(len(segments), k=1))
    a, b = segments[first], segments[second]
    best = np.full(len(first), np.inf)
    middles = np.zeros((len(first), 2))
    for one, other in ((a, b), (b, a)):
        for end in (one[:, :2], one[:, 2:]):
            foot = _foot(end, other)
            gap = np.hypot(*(end - foot).T)
            nearer = gap < best
            best = np.where(nearer, gap, best)
            middles = np.where(nearer[:, None], (end + foot) / 2.0, middles)
    cross, where = _crossing(a, b)
    return _Pairs(
        first, second, np.where(cross, 0.0, best), np.where(cross[:, None], where, middles)
    )


def _apart(world: World) -> npt.NDArray[np.bool_]:
    """Which pairs, in the order of `triu_indices`, are not neighbours on one loop."""
    loop = np.concatenate([np.full(len(wall.points), k) for k, wall in enumerate(world.walls)])
    place = np.concatenate([np.arange(len(wall.points)) for wall in world.walls])
    size = np.array([len(wall.points) for wall in world.walls])[loop]
    i, j = np.triu_indices(len(loop), k=1)
    step = (place[j] - place[i]) % size[i]
    neighbours = (loop[i] == loop[j]) & ((step == 1) | (step == size[i] - 1))
    return np.asarray(~neighbours)


def _foot(points: Floats, segments: Floats) -> Floats:
    """The place on each segment that is closest to each point; float64 [n, 2]."""
    start, along = segments[:, :2], segments[:, 2:] - segments[:, :2]
    part = np.einsum("ij,ij->i", points - start, along) / np.einsum("ij,ij->i", along, along)
    return np.asarray(start + np.clip(part, 0.0, 1.0)[:, None] * along)


def _crossing(a: Floats, b: Floats) -> tuple[npt.NDArray[np.bool_], Floats]:
    """Which pairs of segments cross between their ends, and where."""
    p, r = a[:, :2], a[:, 2:] - a[:, :2]
    q, s = b[:, :2], b[:, 2:] - b[:, :2]
    turn = r[:, 0] * s[:, 1] - r[:, 1] * s[:, 0]
    safe = np.where(turn == 0.0, 1.0, turn)
    off = q - p
    t = (off[:, 0] * s[:, 1] - off[:, 1] * s[:, 0]) / safe
    u = (off[:, 0] * r[:, 1] - off[:, 1] * r[:, 0]) / safe
    cross = (turn != 0.0) & (t > 0.0) & (t < 1.0) & (u > 0.0) & (u < 1.0)
    return cross, p + t[:, None] * r


# ---------------------------------------------------------------- walls


def _thin_walls(world: World, geometry: ActionGeometry) -> list[str]:
    """Walls between two free sides that are thinner than motion or simulation can bear."""
    names, pairs, lines = _named(world), _pairs(world), []
    solid = ~world.between_walls(pairs.middles)
    for k in np.flatnonzero(solid & (pairs.gaps_m < geometry.step_m - 1e-9)):
        (x, y), gap = pairs.middles[k], pairs.gaps_m[k]
        lines.append(
            f"walls: {names[pairs.first[k]]} and {names[pairs.second[k]]} are {gap:.3f} m apart at "
            f"({x:.2f}, {y:.2f}), thinner than {_thinner_than(gap, geometry)}"
        )
    return lines


def _thinner_than(gap_m: float, geometry: ActionGeometry) -> str:
    if gap_m < SUBSTEP_M:
        return f"one step of the simulation ({SUBSTEP_M} m): a robot can get through"
    if gap_m < WALL_THICKNESS_M:
        return f"the solid behind each wall ({WALL_THICKNESS_M} m), which would stand in the way"
    return f"one action is long ({geometry.step_m:.2f} m)"


# ---------------------------------------------------------------- reach


def _unreachable(world: World, geometry: ActionGeometry) -> list[str]:
    """Starts in contact, starts and places that cannot be reached, parts nobody can enter."""
    lines, starts = [], []
    for i, start in enumerate(world.starts):
        gap = float(world.clearance(np.array([[start.x_m, start.y_m]]))[0]) - geometry.radius_m
        at = f"starts.{i}: ({start.x_m:g}, {start.y_m:g})"
        if gap <= CONTACT_M:
            lines.append(f"{at} touches a wall or an obstacle (gap {gap:.3f} m)")
        else:
            starts.append((i, at, start.x_m, start.y_m))
    if not starts:
        return lines
    parts = Reach(world, geometry.radius_m)
    first, _, x, y = starts[0]
    home = parts.part_of(x, y)
    for _, at, x, y in starts:
        here = parts.part_of(x, y)
        if parts.size_m(here) < geometry.step_m:
            lines.append(f"{at} is shut in: there is no room for one action")
        elif here != home:
            lines.append(f"{at} cannot be reached from starts.{first}")
    places = () if world.route is None else world.route.places
    for i, place in enumerate(places):
        if parts.part_of(place.x_m, place.y_m) != home:
            lines.append(f"route.places.{i}: {place.name!r} cannot be reached from starts.{first}")
    entered = {parts.part_of(x, y) for _, _, x, y in starts}
    for part in range(1, parts.count + 1):
        if part not in entered and parts.area_m2(part) > _SMALL_M2:
            x, y = parts.somewhere(part)
            lines.append(
                f"a part of {parts.area_m2(part):.1f} m2 round ({x:.1f}, {y:.1f}) "
                "cannot be reached from any start"
            )
    return lines


class Reach:
    """Connected parts of the places where a robot's middle can be, by flood fill over a grid."""

    def __init__(self, world: World, radius_m: float) -> None:
        x0, y0, x1, y1 = world.bounds
        rows, columns = math.ceil((y1 - y0) / CELL_M) + 1, math.ceil((x1 - x0) / CELL_M) + 1
        y, x = np.mgrid[0:rows, 0:columns] * CELL_M
        room = world.clearance(np.column_stack([x.ravel() + x0, y.ravel() + y0]))
        fits = (room > radius_m).reshape(rows, columns).astype(np.uint8)
        count, labels, self._stats, _ = cv2.connectedComponentsWithStats(fits, connectivity=4)
        self.origin, self.count = (x0, y0), count - 1
        self.labels = np.asarray(labels, np.int32)
        """int32 [rows, columns]: 0 where it cannot be, else the number of the part."""

    def part_of(self, x_m: float, y_m: float) -> int:
        """Number of the part that a place belongs to, or the nearest one within two cells; or 0."""
        row, column = round((y_m - self.origin[1]) / CELL_M), round((x_m - self.origin[0]) / CELL_M)
        for ring in range(3):
            near = self.labels[
                max(row - ring, 0) : row + ring + 1, max(column - ring, 0) : column + ring + 1
            ]
            if near.any():
                return int(near[near > 0][0])
        return 0

    def area_m2(self, part: int) -> float:
        """Area of a part."""
        return float(self._stats[part, cv2.CC_STAT_AREA]) * CELL_M**2

    def size_m(self, part: int) -> float:
        """The longer side of the rectangle round a part."""
        sides = self._stats[part, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]]
        return float(sides.max() - 1) * CELL_M

    def somewhere(self, part: int) -> tuple[float, float]:
        """A place in a part."""
        rows, columns = np.nonzero(self.labels == part)
        k = len(rows) // 2
        return self.origin[0] + columns[k] * CELL_M, self.origin[1] + rows[k] * CELL_M


# ---------------------------------------------------------------- looks


def _looks(world: World) -> list[str]:
    """Fixtures painted over each other, textures nobody sees."""
    lines = []
    for (i, a), (k, b) in itertools.combinations(enumerate(world.fixtures), 2):
        if (a.wall, a.segment) == (b.wall, b.segment) and _overlap(a, b):
            lines.append(f"fixtures.{i} and fixtures.{k}: {a.kind} and {b.kind} overlap")
    used = {world.floor.texture, world.ceiling.texture}
    used.update(name for wall in world.walls for name in wall.textures)
    lines += [f"textures.{name}: used nowhere" for name in world.textures if name not in used]
    return lines


def _overlap(a: Fixture, b: Fixture) -> bool:
    beside = abs(a.at_m - b.at_m) >= (a.width_m + b.width_m) / 2 - 1e-9
    above = (
        a.bottom_m >= b.bottom_m + b.height_m - 1e-9 or b.bottom_m >= a.bottom_m + a.height_m - 1e-9
    )
    return not (beside or above)
