"""Reads tables over a grid of positions and headings, also between grid poses."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from services.robot_driver.atlas.action_geometry import TURNS, ActionGeometry, Floats

Table = npt.NDArray[np.float32]
"""float32 [headings, rows, columns]: rows run along y, columns along x, from the lower corner."""
_WAY_POINTS = 5
"""Points at which the way of one action is looked at."""


class PoseGrid:
    """Poses in a rectangle.

    Args:
        bounds: x and y of the lower corner, x and y of the upper corner, metres.
        geometry: Geometry of the actions.
        cell_m: Grid distance of positions.
        headings: Number of grid headings.
    """

    def __init__(
        self,
        bounds: tuple[float, float, float, float],
        geometry: ActionGeometry,
        cell_m: float,
        headings: int,
    ) -> None:
        self.headings = headings
        self._geometry, self._cell_m = geometry, cell_m
        x0, y0, x1, y1 = bounds
        self._origin = np.array([x0, y0])
        columns, rows = math.ceil((x1 - x0) / cell_m) + 1, math.ceil((y1 - y0) / cell_m) + 1
        y, x = np.mgrid[0:rows, 0:columns] * cell_m
        self.shape = rows, columns
        self.points: Floats = np.column_stack([x.ravel() + x0, y.ravel() + y0])
        """float64 [rows * columns, 2]: the positions."""

    @property
    def heading_step(self) -> float:
        """Angle between two grid headings, radians."""
        return 2.0 * math.pi / self.headings

    def least_on_way(self, plane: Table, action: int) -> Table:
        """Least value of a plane [rows, columns] on the way of one action from each grid pose."""
        parts = [(i + 1) / _WAY_POINTS for i in range(_WAY_POINTS)]
        return np.stack(
            [
                np.minimum.reduce([self._shifted(plane, h, action, p, -1.0) for p in parts])
                for h in range(self.headings)
            ]
        )

    def after(self, table: Table, action: int, outside: float) -> Table:
        """The table's values where one action leads from each grid pose, interpolated."""
        turn = TURNS[action] * self._geometry.turn_rad / self.heading_step
        low = math.floor(turn + 1e-9)
        part = np.float32(turn - low) if turn - low > 1e-9 else np.float32(0.0)
        ahead = np.roll(table, -low, axis=0)
        if part:
            ahead = (1 - part) * ahead + part * np.roll(table, -low - 1, axis=0)
        return np.stack(
            [self._shifted(ahead[h], h, action, 1.0, outside) for h in range(self.headings)]
        )

    def _shifted(self, plane: Table, h: int, action: int, part: float, outside: float) -> Table:
        """One heading's plane, read at the place where part of an action leads."""
        there = self._geometry.move(np.array([[0.0, 0.0, h * self.heading_step]]), action, part)[0]
        dx, dy = there[0] / self._cell_m, there[1] / self._cell_m
        return np.asarray(
            cv2.warpAffine(
                plane,
                np.array([[1.0, 0.0, dx], [0.0, 1.0, dy]]),
                (plane.shape[1], plane.shape[0]),
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=(outside,),
            ),
            np.float32,
        )

    def look_up(self, table: Table, poses: Floats) -> Floats:
        """Interpolated values of a table at float64 [n, 3], float64 [n]; grid edges repeat."""
        rows, columns = self.shape
        grid = (poses[:, :2] - self._origin) / self._cell_m
        x = np.clip(grid[:, 0], 0.0, columns - 1.001)
        y = np.clip(grid[:, 1], 0.0, rows - 1.001)
        h = np.remainder(poses[:, 2] / self.heading_step, self.headings)
        result = np.zeros(len(poses))
        for dh in (0, 1):
            for dy in (0, 1):
                for dx in (0, 1):
                    weight = np.ones(len(poses))
                    for value, far in ((h, dh), (y, dy), (x, dx)):
                        rest = value - np.floor(value)
                        weight *= rest if far else 1.0 - rest
                    result += weight * table[
                        (np.floor(h).astype(np.int64) + dh) % self.headings,
                        np.floor(y).astype(np.int64) + dy,
                        np.floor(x).astype(np.int64) + dx,
                    ]  # fmt: skip
        return result
