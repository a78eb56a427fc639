"""What is possible with full knowledge of the map and the three actions (A4, A21).

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

import cv2
import numpy as np
import numpy.typing as npt

from services.robot_driver.simulated.world import World
from shared.config import RobotConfig
from shared.facts import ACTION_COUNT, ACTIONS

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Table = npt.NDArray[np.float32]
"""float32 [headings, rows, columns]: rows run along y, columns along x, from the lower corner."""

TURNS = tuple(float(action.turn) for action in ACTIONS)
"""Turn of every action in units of the turn rate."""
CONTACT_M = 0.001
"""Gap to a wall that counts as contact, as in the simulation."""
_EXACT_STEP_M = 0.01
_TABLE_STEPS = 5
"""Points at which the tables look at the way of one action."""
_DISCOUNT = 0.99
_SWEEPS = 250
_ARRIVAL_M = 1.0
"""The last part of a route, where a tour has arrived."""
_CORNER_M = 2.5
"""Corners of a route may be cut; who gets farther ahead at once has left out a part of it."""
_ARRIVAL_GAIN = 100.0
"""Of each action there: worth more than turning back before a dead end."""
_LOST = -100.0
"""Value of a run that cannot go on."""


@dataclass(frozen=True)
class Motion:
    """The three actions and the round shell, as far as geometry is concerned."""

    step_m: float
    """Forward way of one action."""
    turn_rad: float
    """Turn of one turning action."""
    radius_m: float

    @classmethod
    def of(cls, config: RobotConfig) -> Motion:
        """The motion of a configured robot."""
        period = config.period_s
        return cls(config.speed_m_s * period, config.turn_rad_s * period, config.radius_m)

    @property
    def turning_radius_m(self) -> float:
        """Radius of the arc that a turning action drives."""
        return self.step_m / self.turn_rad

    def move(self, poses: Floats, action: int, part: float = 1.0) -> Floats:
        """Where part of an action leads: float64 [n, 3] of x, y, heading to the same."""
        half = TURNS[action] * self.turn_rad * part / 2.0
        chord = self.step_m * part * (math.sin(half) / half if half else 1.0)
        heading = poses[:, 2] + half
        x = poses[:, 0] + chord * np.cos(heading)
        y = poses[:, 1] + chord * np.sin(heading)
        return np.column_stack([x, y, heading + half])

    def gap(self, world: World, poses: Floats, action: int) -> Floats:
        """Least gap to a wall on the way of one action, looked at every centimetre; float64 [n]."""
        steps = math.ceil(self.step_m / _EXACT_STEP_M - 1e-9)
        way = [self.move(poses, action, (i + 1) / steps)[:, :2] for i in range(steps)]
        gaps = world.clearance(np.vstack(way)).reshape(steps, len(poses))
        return np.asarray(gaps.min(axis=0)) - self.radius_m


@dataclass(frozen=True)
class Run:
    """Planned runs from n poses."""

    survived: Ints
    """[n]: actions without contact."""
    actions: Ints
    """[steps, n]: what was chosen; meaningless after the run ended."""
    poses: Floats
    """[steps + 1, n, 3]; the last one stays when the run ended."""


Gain = Callable[[Floats, Floats], Floats]
"""Progress between poses before and after an action: two float64 [n, 3] to float64 [n].

Minus infinity where the action is not wanted at all.
"""


@dataclass(frozen=True)
class _Aim:
    """What a run makes for while it keeps some room."""

    gain: Gain
    keep_m: float
    table: Table


class Planner:
    """Tables for one world and one motion.

    Args:
        world: The map.
        motion: The three actions.
        cell_m: Grid distance of positions.
        headings: Number of grid headings.
        horizon: Actions a saved run lasts.
    """

    def __init__(
        self,
        world: World,
        motion: Motion,
        *,
        cell_m: float = 0.05,
        headings: int = 48,
        horizon: int = 500,
    ) -> None:
        self.world = world
        self.motion = motion
        self._cell_m = cell_m
        self._headings = headings
        x0, y0, x1, y1 = world.bounds
        self._origin = np.array([x0, y0])
        columns, rows = math.ceil((x1 - x0) / cell_m) + 1, math.ceil((y1 - y0) / cell_m) + 1
        y, x = np.mgrid[0:rows, 0:columns] * cell_m
        self._points = np.column_stack([x.ravel() + x0, y.ravel() + y0])
        room = world.clearance(self._points) - motion.radius_m
        self._room: Table = room.reshape(rows, columns).astype(np.float32)
        self._way = [self._way_room(action) for action in range(ACTION_COUNT)]
        self._margin = self._margin_table(horizon)
        self._aims: dict[tuple[int, float], _Aim] = {}

    def drive(self, poses: Floats, actions: int) -> Run:
        """Planned runs that keep most room, from poses float64 [n, 3]."""
        return self._roll_out(poses, actions, None)

    def race(self, pose: Floats, actions: int, direction: int, keep_m: float = 0.005) -> Run:
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

        return self._pursue(pose, actions, (direction, keep_m), turned)

    def tour(self, actions: int, keep_m: float = 0.005) -> Run:
        """The planned run along the world's route, from its first point towards its second.

        Args:
            actions: Length of the run, at most; it may go on beyond the end of the route.
            keep_m: Room to keep to all walls.

        Raises:
            ValueError: The world has no route.
        """
        track = self._track()
        (x, y), (ahead_x, ahead_y) = track.points[:2]
        pose = np.array([x, y, math.atan2(ahead_y - y, ahead_x - x)])

        near_end_m = track.length_m - _ARRIVAL_M

        def advanced(before: Floats, after: Floats) -> Floats:
            gain = track.along(after) - track.along(before)
            arrived = track.along(after) > near_end_m
            follows = np.abs(gain) <= _CORNER_M
            return np.where(follows, gain + _ARRIVAL_GAIN * arrived, -np.inf)

        return self._pursue(pose, actions, (0, keep_m), advanced)

    def progress(self, poses: Floats) -> Floats:
        """How far along the world's route poses float64 [n, 3] are, metres, float64 [n].

        Raises:
            ValueError: The world has no route.
        """
        return self._track().along(poses)

    def winding(self, poses: Floats) -> Floats:
        """Net angle round the lap centre along float64 [steps, 3], radians, float64 [steps].

        Raises:
            ValueError: The world has no lap centre.
        """
        angle = np.unwrap(self._bearing(poses))
        return np.asarray(angle - angle[0])

    def _pursue(self, pose: Floats, actions: int, key: tuple[int, float], gain: Gain) -> Run:
        """A run for gain; the key is its direction, 0 along the route, and the room to keep."""
        if key not in self._aims:
            keep_m = key[1]
            self._aims[key] = _Aim(gain, keep_m, self._gain_table(gain, keep_m))
        return self._roll_out(pose[None, :], actions, self._aims[key])

    def _roll_out(self, poses: Floats, actions: int, aim: _Aim | None) -> Run:
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
                safe[mine] = self.motion.gap(self.world, poses[mine], action) > CONTACT_M
                poses[mine] = self.motion.move(poses[mine], action)
            alive = alive[safe[alive]]
            survived[alive] += 1
            chosen_all.append(chosen)
            poses_all.append(poses.copy())
            if not len(alive):
                break
        return Run(survived, np.array(chosen_all, np.int64), np.array(poses_all))

    def _choose(self, poses: Floats, aim: _Aim | None) -> Ints:
        """The action with most room on its way and after it, or with most progress if safe."""
        scores = []
        for action in range(ACTION_COUNT):
            after = self.motion.move(poses, action)
            room = np.minimum(
                self._look_up(self._way[action], poses), self._look_up(self._margin, after)
            )
            if aim is not None:
                value = aim.gain(poses, after) + _DISCOUNT * self._look_up(aim.table, after)
                room = np.where(room > aim.keep_m, value, room - 100.0)
            scores.append(room)
        return np.asarray(np.argmax(np.stack(scores), axis=0), np.int64)

    def _margin_table(self, horizon: int) -> Table:
        """Room kept at the narrowest place of the best run of `horizon` actions."""
        table = np.repeat(self._room[None], self._headings, axis=0)
        for _ in range(horizon):
            best = [
                np.minimum(self._way[a], self._after(table, a, -1.0)) for a in range(ACTION_COUNT)
            ]
            new = np.minimum(table, np.maximum.reduce(best))
            if np.array_equal(new, table):
                break
            table = new
        return table

    def _gain_table(self, gain: Gain, keep_m: float) -> Table:
        """Discounted gain of the best safe run."""
        before = np.column_stack([self._points, np.zeros(len(self._points))])
        gains = []
        for action in range(ACTION_COUNT):
            table = np.empty_like(self._margin)
            for h in range(self._headings):
                before[:, 2] = h * self._heading_step
                after = self.motion.move(before, action)
                table[h] = gain(before, after).reshape(self._room.shape)
            room = np.minimum(self._way[action], self._after(self._margin, action, -1.0))
            gains.append(np.where(room > keep_m, table, np.float32(-np.inf)))
        table = np.zeros_like(self._margin)
        for _ in range(_SWEEPS):
            best = [gains[a] + _DISCOUNT * self._after(table, a, 0.0) for a in range(ACTION_COUNT)]
            table = np.maximum(np.maximum.reduce(best), np.float32(_LOST))
        return table

    def _track(self) -> _Track:
        if self.world.route is None:
            raise ValueError(f"world {self.world.name!r} has no route")
        return _Track(np.array(self.world.route.points, np.float64))

    @property
    def _heading_step(self) -> float:
        return 2.0 * math.pi / self._headings

    def _bearing(self, poses: Floats) -> Floats:
        if self.world.lap is None:
            raise ValueError(f"world {self.world.name!r} has no lap centre")
        cx, cy = self.world.lap.centre
        return np.asarray(np.arctan2(poses[:, 1] - cy, poses[:, 0] - cx))

    def _way_room(self, action: int) -> Table:
        """Least room on the way of one action from each grid pose."""
        parts = [(i + 1) / _TABLE_STEPS for i in range(_TABLE_STEPS)]
        return np.stack(
            [
                np.minimum.reduce([self._shift(self._room, h, action, p, -1.0) for p in parts])
                for h in range(self._headings)
            ]
        )

    def _after(self, table: Table, action: int, outside: float) -> Table:
        """The table's values where one action leads from each grid pose, interpolated."""
        turn = TURNS[action] * self.motion.turn_rad / self._heading_step
        low = math.floor(turn + 1e-9)
        part = np.float32(turn - low) if turn - low > 1e-9 else np.float32(0.0)
        ahead = np.roll(table, -low, axis=0)
        if part:
            ahead = (1 - part) * ahead + part * np.roll(table, -low - 1, axis=0)
        return np.stack(
            [self._shift(ahead[h], h, action, 1.0, outside) for h in range(self._headings)]
        )

    def _shift(self, plane: Table, h: int, action: int, part: float, outside: float) -> Table:
        """One heading's plane, read at the place where part of an action leads."""
        there = self.motion.move(np.array([[0.0, 0.0, h * self._heading_step]]), action, part)[0]
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

    def _look_up(self, table: Table, poses: Floats) -> Floats:
        """Interpolated values of a table at float64 [n, 3], float64 [n]; grid edges repeat."""
        rows, columns = self._room.shape
        grid = (poses[:, :2] - self._origin) / self._cell_m
        x = np.clip(grid[:, 0], 0.0, columns - 1.001)
        y = np.clip(grid[:, 1], 0.0, rows - 1.001)
        h = np.remainder(poses[:, 2] / self._heading_step, self._headings)
        result = np.zeros(len(poses))
        for dh in (0, 1):
            for dy in (0, 1):
                for dx in (0, 1):
                    weight = np.ones(len(poses))
                    for value, far in ((h, dh), (y, dy), (x, dx)):
                        rest = value - np.floor(value)
                        weight *= rest if far else 1.0 - rest
                    result += weight * table[
                        (np.floor(h).astype(np.int64) + dh) % self._headings,
                        np.floor(y).astype(np.int64) + dy,
                        np.floor(x).astype(np.int64) + dx,
                    ]  # fmt: skip
        return result


@dataclass(frozen=True)
class _Track:
    """A line of straight legs between points float64 [n, 2]."""

    points: Floats

    @property
    def length_m(self) -> float:
        """Of all legs."""
        return float(np.hypot(*np.diff(self.points, axis=0).T).sum())

    def along(self, poses: Floats) -> Floats:
        """Way from the first point to the place closest to each pose, float64 [n], metres."""
        start, legs = self.points[:-1], np.diff(self.points, axis=0)
        lengths = np.hypot(*legs.T)
        offset = poses[:, None, :2] - start
        part = np.clip(np.einsum("nlj,lj->nl", offset, legs) / lengths**2, 0.0, 1.0)
        gaps = np.hypot(*(offset - part[..., None] * legs).transpose(2, 0, 1))
        leg = gaps.argmin(axis=1)
        before = np.concatenate([[0.0], np.cumsum(lengths)])
        return np.asarray(before[leg] + part[np.arange(len(poses)), leg] * lengths[leg])


def _wrap(angle_rad: Floats) -> Floats:
    return np.asarray(np.remainder(angle_rad + math.pi, 2.0 * math.pi) - math.pi)
