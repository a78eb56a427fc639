"""What is possible with full knowledge of the map and the actions (A4, A21).

Two tables over a grid of positions and headings come from value iteration: how much room the best
run of `horizon` actions keeps at its narrowest place, and how fast laps can be driven. Tables
guide, they prove nothing: every figure comes from rolling the guided actions out with exact motion
and exact geometry, so a real sequence of actions reaches it. A pose called saved is saved; one
called lost might still be saved by a better plan.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from services.robot_driver.atlas.action_geometry import CONTACT_M, ActionGeometry, Floats
from services.robot_driver.atlas.pose_grid import PoseGrid, Table
from services.robot_driver.simulated.world import World
from shared.facts import ACTION_COUNT

Ints = npt.NDArray[np.int64]

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


Gain = Callable[[Floats, Floats], Floats]
"""Progress between poses before and after an action: two float64 [n, 3] to float64 [n]."""


@dataclass(frozen=True)
class _Aim:
    """What a run makes for while it keeps some room."""

    gain: Gain
    keep_m: float
    table: Table


class Planner:
    """Tables for one world and one robot.

    Args:
        world: The map.
        geometry: Geometry of the three actions.
        cell_m: Grid distance of positions.
        headings: Number of grid headings.
        horizon: Actions a saved run lasts.
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
        self._aims: dict[tuple[int, float], _Aim] = {}

    def drive(self, poses: Floats, actions: int) -> PlannedRuns:
        """Planned runs that keep most room, from poses float64 [n, 3]."""
        return self._roll_out(poses, actions, None)

    def race(
        self, pose: Floats, actions: int, direction: int, keep_m: float = 0.005
    ) -> PlannedRuns:
        """The planned run from one pose [3] with most net angle round the lap centre.

        Where the room to keep cannot be kept, it makes for more room first.

        Args:
            pose: x, y, heading.
            actions: Length of the run.
            direction: 1 anticlockwise, -1 clockwise.
            keep_m: Room to keep to all walls.

        Raises:
            ValueError: The world has no lap centre.
        """

        def turned(before: Floats, after: Floats) -> Floats:
            return direction * _wrap(self._bearing(after) - self._bearing(before))

        key = (direction, keep_m)
        if key not in self._aims:
            self._aims[key] = _Aim(turned, keep_m, self._gain_table(turned, keep_m))
        return self._roll_out(pose[None, :], actions, self._aims[key])

    def winding(self, poses: Floats) -> Floats:
        """Net angle round the lap centre along float64 [steps, 3], radians, float64 [steps].

        Raises:
            ValueError: The world has no lap centre.
        """
        angle = np.unwrap(self._bearing(poses))
        return np.asarray(angle - angle[0])

    def _roll_out(self, poses: Floats, actions: int, aim: _Aim | None) -> PlannedRuns:
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

    def _choose(self, poses: Floats, aim: _Aim | None) -> Ints:
        """The action with most room on its way and after it, or with most progress if safe."""
        scores = []
        for action in range(ACTION_COUNT):
            after = self.geometry.move(poses, action)
            room = np.minimum(
                self._grid.look_up(self._way[action], poses),
                self._grid.look_up(self._margin, after),
            )
            if aim is not None:
                value = aim.gain(poses, after) + _DISCOUNT * self._grid.look_up(aim.table, after)
                room = np.where(room > aim.keep_m, value, room - 100.0)
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

    def _gain_table(self, gain: Gain, keep_m: float) -> Table:
        """Discounted gain of the best safe run."""
        before = np.column_stack([self._grid.points, np.zeros(len(self._grid.points))])
        gains = []
        for action in range(ACTION_COUNT):
            table = np.empty_like(self._margin)
            for h in range(self._grid.headings):
                before[:, 2] = h * self._grid.heading_step
                after = self.geometry.move(before, action)
                table[h] = gain(before, after).reshape(self._grid.shape)
            room = np.minimum(self._way[action], self._grid.after(self._margin, action, -1.0))
            gains.append(np.where(room > keep_m, table, np.float32(-np.inf)))
        table = np.zeros_like(self._margin)
        for _ in range(_SWEEPS):
            best = [
                gains[a] + _DISCOUNT * self._grid.after(table, a, 0.0) for a in range(ACTION_COUNT)
            ]
            table = np.maximum(np.maximum.reduce(best), np.float32(_LOST))
        return table

    def _bearing(self, poses: Floats) -> Floats:
        if self.world.lap is None:
            raise ValueError(f"world {self.world.name!r} has no lap centre")
        cx, cy = self.world.lap.centre
        return np.asarray(np.arctan2(poses[:, 1] - cy, poses[:, 0] - cx))


def _wrap(angle_rad: Floats) -> Floats:
    return np.asarray(np.remainder(angle_rad + math.pi, 2.0 * math.pi) - math.pi)
