"""What is possible with full knowledge of the map and the actions (A4, A21).

Two tables over a grid of positions and headings come from value iteration: how much room the best
run of `horizon` actions keeps at its narrowest place, and how fast laps can be driven. Tables
guide, they prove nothing: every figure comes from rolling the guided actions out with exact motion
and exact geometry, so a real sequence of actions reaches it. A pose called saved is saved; one
called lost might still be saved by a better plan.
"""

import math
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
import numpy.typing as npt

from services.robot_driver.atlas.action_geometry import CONTACT_M, TURNS, ActionGeometry, Floats
from services.robot_driver.simulated.world import World
from shared.facts import ACTION_COUNT

Ints = npt.NDArray[np.int64]
Table = npt.NDArray[np.float32]
"""float32 [headings, rows, columns]: rows run along y, columns along x, from the lower corner."""
_WAY_POINTS = 5
"""Points at which the way of one action is looked at."""

_DISCOUNT = 0.99
_SWEEPS = 250
_LOST = -100.0
"""Value of a run that cannot go on."""


@dataclass(frozen=True)
class PlannedRuns:
    """Planned runs from n poses."""

    survived: Ints
    """[n]: actions without contact."""
    actions: Ints
    """[steps, n]: what was chosen; meaningless after the run ended."""
    poses: Floats
    """[steps + 1, n, 3]; the last one stays when the run ended."""


Aim = tuple[int, float]
"""What a run makes for: a direction round the lap centre, while it keeps some room in metres."""


class Planner:
    """Tables for one world and one robot, over a grid of positions and headings.

    horizon: Actions that a saved run lasts.
    """

    def __init__(
        self,
        world: World,
        geometry: ActionGeometry,
        *,
        cell_m: float = 0.05,
        headings: int = 48,
        horizon: int = 500,
    ) -> None:
        self.world = world
        self.geometry = geometry
        self._grid = PoseGrid(world.bounds, geometry, cell_m, headings)
        room = world.clearance(self._grid.points) - geometry.radius_m
        self._room = room.reshape(self._grid.shape).astype(np.float32)
        """float32 [rows, columns]: gap to a wall at every position."""
        self._way = [self._grid.least_on_way(self._room, a) for a in range(ACTION_COUNT)]
        self._margin = self._margin_table(horizon)
        self._gains: dict[Aim, Table] = {}

    def drive(self, poses: Floats, actions: int) -> PlannedRuns:
        """Planned runs that keep most room, from poses float64 [n, 3]."""
        return self._roll_out(poses, actions, None)

    def race(
        self, pose: Floats, actions: int, direction: int, keep_m: float = 0.005
    ) -> PlannedRuns:
        """The planned run from one pose (x, y, heading) with most net angle round the lap centre.

        Where the room to keep cannot be kept, it makes for more room first.

        direction: 1 anticlockwise, -1 clockwise. keep_m: Room to keep to all walls.

        Raises ValueError for a world without a lap centre.
        """
        aim = (direction, keep_m)
        if aim not in self._gains:
            self._gains[aim] = self._gain_table(aim)
        return self._roll_out(pose[None, :], actions, aim)

    def winding(self, poses: Floats) -> Floats:
        """Net angle round the lap centre along float64 [steps, 3], radians, float64 [steps].

        Raises ValueError for a world without a lap centre.
        """
        angle = np.unwrap(self._bearing(poses))
        return np.asarray(angle - angle[0])

    def _roll_out(self, poses: Floats, actions: int, aim: Aim | None) -> PlannedRuns:
        poses = poses.copy()
        survived = np.zeros(len(poses), np.int64)
        alive = np.arange(len(poses))
        chosen_all, poses_all = [], [poses.copy()]
        for _ in range(actions):
            chosen = np.zeros(len(poses), np.int64)
            chosen[alive] = self._choose(poses[alive], aim)
            safe = np.zeros(len(poses), np.bool_)
            for action in range(ACTION_COUNT):
                mine = alive[chosen[alive] == action]
                safe[mine] = self.geometry.gap(self.world, poses[mine], action) > CONTACT_M
                poses[mine] = self.geometry.move(poses[mine], action)
            alive = alive[safe[alive]]
            survived[alive] += 1
            chosen_all.append(chosen)
            poses_all.append(poses.copy())
            if not len(alive):
                break
        return PlannedRuns(survived, np.array(chosen_all, np.int64), np.array(poses_all))

    def _choose(self, poses: Floats, aim: Aim | None) -> Ints:
        """The action with most room on its way and after it, or with most progress if safe."""
        scores = []
        for action in range(ACTION_COUNT):
            after = self.geometry.move(poses, action)
            room = np.minimum(
                self._grid.look_up(self._way[action], poses),
                self._grid.look_up(self._margin, after),
            )
            if aim is not None:
                later = self._grid.look_up(self._gains[aim], after)
                value = self._turned(poses, after, aim) + _DISCOUNT * later
                room = np.where(room > aim[1], value, room - 100.0)
            scores.append(room)
        return np.asarray(np.argmax(np.stack(scores), axis=0), np.int64)

    def _margin_table(self, horizon: int) -> Table:
        """Room kept at the narrowest place of the best run of `horizon` actions."""
        table = np.repeat(self._room[None], self._grid.headings, axis=0)
        for _ in range(horizon):
            best = [
                np.minimum(self._way[a], self._grid.after(table, a, -1.0))
                for a in range(ACTION_COUNT)
            ]
            new = np.minimum(table, np.maximum.reduce(best))
            if np.array_equal(new, table):
                break
            table = new
        return table

    def _gain_table(self, aim: Aim) -> Table:
        """Discounted gain of the best safe run."""
        before = np.column_stack([self._grid.points, np.zeros(len(self._grid.points))])
        gains = []
        for action in range(ACTION_COUNT):
            table = np.empty_like(self._margin)
            for h in range(self._grid.headings):
                before[:, 2] = h * self._grid.heading_step
                after = self.geometry.move(before, action)
                table[h] = self._turned(before, after, aim).reshape(self._grid.shape)
            room = np.minimum(self._way[action], self._grid.after(self._margin, action, -1.0))
            gains.append(np.where(room > aim[1], table, np.float32(-np.inf)))
        table = np.zeros_like(self._margin)
        for _ in range(_SWEEPS):
            best = [
                gains[a] + _DISCOUNT * self._grid.after(table, a, 0.0) for a in range(ACTION_COUNT)
            ]
            table = np.maximum(np.maximum.reduce(best), np.float32(_LOST))
        return table

    def _turned(self, before: Floats, after: Floats, aim: Aim) -> Floats:
        """Angle round the lap centre between poses float64 [n, 3], in the wanted direction."""
        angle = self._bearing(after) - self._bearing(before)
        return aim[0] * np.asarray(np.remainder(angle + math.pi, 2.0 * math.pi) - math.pi)

    def _bearing(self, poses: Floats) -> Floats:
        if self.world.lap is None:
            raise ValueError(f"world {self.world.name!r} has no lap centre")
        cx, cy = self.world.lap.centre
        return np.asarray(np.arctan2(poses[:, 1] - cy, poses[:, 0] - cx))


class PoseGrid:
    """Poses in a rectangle.

    bounds: x and y of the lower corner, x and y of the upper corner, metres.
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
        for dh, dy, dx in product((0, 1), repeat=3):
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
