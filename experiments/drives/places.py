"""Where a robot can be in a world: free cells to be covered, poses to start from."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from services.robot_driver.robot import Pose
from services.robot_driver.simulated.world import World
from shared.rl.draws import generator

Floats = npt.NDArray[np.float64]

SEED = 7
"""Seed of starts and random actions, the same for every network."""
CELL_M = 0.5
"""Edge of the cells that coverage counts."""
GRID_M = 0.05
"""Distance of the points at which free space is looked at."""
ROOM_M = 0.8
"""Starts keep this to all walls, less where corridors are narrow: each can be driven on from."""
ROOMIEST = 0.25
"""Starts lie in at least this part of the free space, however narrow it is."""
JITTER_RAD = math.radians(20.0)
"""Largest angle between a start's heading and the nearest wall."""


@dataclass(frozen=True)
class Cells:
    """Square cells that the middle of a robot can get into."""

    free: frozenset[tuple[int, int]]
    """Column and row, counted from the lower corner of the world."""
    corner_m: tuple[float, float]

    def of(self, places_m: Floats) -> set[tuple[int, int]]:
        """The free cells in which places float64 [n, 2] lie."""
        return _steps(places_m, self.corner_m) & self.free

    def visited(self, places_m: Floats) -> float:
        """Part of the free cells in which places float64 [n, 2] lie."""
        return len(self.of(places_m)) / len(self.free)


def free_cells(world: World, radius_m: float) -> Cells:
    """Cells with a place where a robot of this radius fits and to which it gets from a start."""
    return _cells(world, reachable(world, radius_m))


def reachable(world: World, radius_m: float) -> Floats:
    """Grid points float64 [n, 2] where a robot fits, reached from a start; or ValueError."""
    x0, y0, x1, y1 = world.bounds
    columns, rows = int((x1 - x0) / GRID_M), int((y1 - y0) / GRID_M)
    y, x = (np.mgrid[0:rows, 0:columns] + 0.5) * GRID_M
    points = np.column_stack([x.ravel() + x0, y.ravel() + y0])
    fits = (world.clearance(points) >= radius_m).reshape(rows, columns)
    _, part_of = cv2.connectedComponents(fits.astype(np.uint8), connectivity=4)
    starts = np.array([(start.x_m - x0, start.y_m - y0) for start in world.starts])
    column, row = (starts / GRID_M).astype(np.int64).T
    mine = np.isin(part_of, np.unique(part_of[row, column])) & fits
    if not mine.any():
        raise ValueError(
            f"world {world.name!r}: a robot of {radius_m} m fits at none of its starts"
        )
    return points[mine.ravel()]


def first_start(world: World) -> Pose:
    """The first start pose of the world's file."""
    start = world.starts[0]
    return Pose(start.x_m, start.y_m, math.remainder(math.radians(start.heading_deg), math.tau))


def start_poses(world: World, radius_m: float, count: int) -> list[Pose]:
    """Poses all over the corridors, by turns in one direction and the other; always the same.

    In a world with a lap centre the first, third ... look anticlockwise round it; elsewhere they
    have the nearest wall on their right, the second, fourth ... on their left.
    """
    around = reachable(world, radius_m)
    room_m = min(ROOM_M, float(np.quantile(world.clearance(around), 1.0 - ROOMIEST)))
    cells = _cells(world, around)
    draw = generator(SEED, "start")
    x0, y0, x1, y1 = world.bounds
    poses: list[Pose] = []
    while len(poses) < count:
        point = draw.uniform((x0, y0), (x1, y1))
        heading = _along(world, point) + math.pi * (len(poses) % 2)
        heading += draw.uniform(-JITTER_RAD, JITTER_RAD)
        if world.clearance(point[None, :])[0] >= room_m and cells.of(point[None, :]):
            turned = math.remainder(heading, 2.0 * math.pi)
            poses.append(Pose(float(point[0]), float(point[1]), turned))
    return poses


def _cells(world: World, points: Floats) -> Cells:
    """Those in which points float64 [n, 2] lie."""
    corner_m = world.bounds[:2]
    return Cells(frozenset(_steps(points, corner_m)), corner_m)


def _steps(places_m: Floats, corner_m: tuple[float, float]) -> set[tuple[int, int]]:
    """Columns and rows of the cells in which places float64 [n, 2] lie."""
    steps = np.unique(np.floor((places_m - corner_m) / CELL_M).astype(np.int64), axis=0)
    return {(int(x), int(y)) for x, y in steps}


def _along(world: World, point: Floats) -> float:
    """Direction of the nearest wall: as an anticlockwise lap passes it, or with it on the right.

    Free space lies on the left of walls: the boundary, which comes first, runs anticlockwise,
    islands run clockwise.
    """
    start, end = world.segments[:, :2], world.segments[:, 2:]
    along = end - start
    part = ((point - start) * along).sum(axis=1) / (along**2).sum(axis=1)
    gap = point - (start + np.clip(part, 0.0, 1.0)[:, None] * along)
    nearest = int(np.argmin((gap**2).sum(axis=1)))
    against = world.lap is not None and nearest >= len(world.walls[0].points)
    sense = -1.0 if against else 1.0
    return math.atan2(sense * along[nearest, 1], sense * along[nearest, 0])
