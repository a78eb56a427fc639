"""The simulated robot: kinematic motion in small steps, a ring bumper and a camera (A1, A2).

What happens next depends on `state()` alone: on pose, velocity, time and laps. PyBullet is only
asked how far the nearest wall is and what the camera sees, so a robot restored in another process
continues bit for bit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from services.robot_driver.robot import STANDSTILL, Felt, Pose, Sensed, Velocity
from services.robot_driver.scene import Scene
from services.robot_driver.world import World
from shared.config import RobotConfig
from shared.rl.preprocess import preprocess

SUBSTEP_M = 0.01
"""Longest way between two looks at the walls: far below their thickness."""
SUBSTEP_RAD = math.radians(5.0)
SKIN_M = 0.001
"""The bumper is pressed while the gap to a wall is at most this."""
GAP_M = 0.0002
"""The shell never comes nearer to a wall than this."""
_HALVINGS = 6
"""Of a substep that would touch: what is left of 1 cm is well inside the skin."""


class Laps(NamedTuple):
    """Laps completed: net, anticlockwise (turning left round the island), clockwise."""

    net: int
    left: int
    right: int


def wrap(angle_rad: float) -> float:
    """The same direction in -pi..pi."""
    return math.remainder(angle_rad, 2.0 * math.pi)


def advance(pose: Pose, velocity: Velocity, duration_s: float) -> Pose:
    """Where constant body velocity leads without walls: exact, an arc when turning."""
    turn = velocity.turn_rad_s * duration_s
    forward, left = velocity.forward_m_s * duration_s, velocity.left_m_s * duration_s
    half = turn / 2.0
    chord = math.sin(half) / half if abs(half) > 1e-9 else 1.0
    c, s = math.cos(pose.heading_rad + half), math.sin(pose.heading_rad + half)
    return Pose(
        pose.x_m + chord * (forward * c - left * s),
        pose.y_m + chord * (forward * s + left * c),
        wrap(pose.heading_rad + turn),
    )


class SimRobot:
    """A Robotino in a world, as `robot.Robot`; deterministic and without noise.

    Args:
        config: Shape, camera and limits of the robot.
        world: Where it drives; it starts at the first start pose.
        seed: Reserved for worlds with chance in them; motion and camera have none.

    Raises:
        ValueError: The start pose touches a wall.
    """

    def __init__(self, config: RobotConfig, world: World, seed: int) -> None:
        self.config = config
        self.world = world
        self.seed = seed
        start = world.starts[0]
        self._pose = Pose(start.x_m, start.y_m, wrap(math.radians(start.heading_deg)))
        self._velocity = STANDSTILL
        self._time_s = 0.0
        self._winding_rad = 0.0
        self._lap_start_rad = 0.0
        self._left = self._right = 0
        self._scene = Scene(world, config.radius_m, config.camera)
        if self._clearance(self._pose) <= SKIN_M:
            self._scene.close()
            raise ValueError(f"world {world.name!r}: starts.0 touches a wall")

    @property
    def pose(self) -> Pose:
        """Where the robot is; without the cost of a picture."""
        return self._pose

    @property
    def contact(self) -> bool:
        """The ring bumper is pressed now, anywhere on the ring."""
        return self._clearance(self._pose) <= SKIN_M

    @property
    def laps(self) -> Laps:
        """Laps so far; one counts when 2 pi of new net angle round the lap centre is reached."""
        return Laps(self._left - self._right, self._left, self._right)

    def frame(self, width_px: int = 0, height_px: int = 0) -> npt.NDArray[np.uint8]:
        """The camera picture before preprocessing: uint8 [h, w, 3], RGB."""
        return self.look_from(self._pose, width_px, height_px)

    def look_from(self, pose: Pose, width_px: int = 0, height_px: int = 0) -> npt.NDArray[np.uint8]:
        """What the camera would see from another pose; the robot stays where it is."""
        return self._scene.frame(pose, width_px, height_px)

    def sense(self) -> Sensed:
        """Camera, pose and bumper now."""
        return Sensed(self._pose, self.contact, preprocess(self.frame()))

    def feel(self) -> Felt:
        """Pose and bumper now, without a picture."""
        return Felt(self._pose, self.contact)

    def drive(self, velocity: Velocity) -> None:
        """Set the body velocity that holds until the next call."""
        self._velocity = velocity

    def run(self, duration_s: float, *, stop_on_contact: bool) -> bool:
        """Let simulated time pass; return whether there was contact at any time (E11).

        A part of a step that would touch a wall is not taken: translation is blocked, rotation
        goes on. Driving off a wall is no contact. With `stop_on_contact` the velocity becomes
        zero at the first contact.
        """
        steps = self._substeps(duration_s)
        touched = False
        free = self._clearance(self._pose)
        for _ in range(steps):
            if not self._velocity.moving:
                break
            free = self._substep(duration_s / steps, free)
            if free <= SKIN_M:
                touched = True
                if stop_on_contact:
                    self._velocity = STANDSTILL
        self._time_s += duration_s
        return touched or (not self._velocity.moving and free <= SKIN_M)

    def now_s(self) -> float:
        """Simulated time since the start."""
        return self._time_s

    def state(self) -> dict[str, float | int | str]:
        """Everything that decides what happens next."""
        return {
            "world": self.world.name,
            "world_fingerprint": self.world.fingerprint,
            "x_m": self._pose.x_m,
            "y_m": self._pose.y_m,
            "heading_rad": self._pose.heading_rad,
            "forward_m_s": self._velocity.forward_m_s,
            "left_m_s": self._velocity.left_m_s,
            "turn_rad_s": self._velocity.turn_rad_s,
            "time_s": self._time_s,
            "winding_rad": self._winding_rad,
            "lap_start_rad": self._lap_start_rad,
            "laps_left": self._left,
            "laps_right": self._right,
        }

    def restore(self, state: dict[str, float | int | str]) -> None:
        """Continue from `state()`.

        Raises:
            ValueError: Another world, a missing or wrong value, or a pose inside a wall. The robot
                is unchanged then.
        """
        if set(state) != set(self.state()):
            odd = sorted(set(state) ^ set(self.state()))
            raise ValueError(f"robot state: missing or unknown {', '.join(odd)}")
        if state["world_fingerprint"] != self.world.fingerprint:
            raise ValueError(f"robot state: is of another world than {self.world.name!r}")
        pose = Pose(*(_number(state, key) for key in ("x_m", "y_m", "heading_rad")))
        if self._clearance(pose) < GAP_M or not self._inside(pose):
            raise ValueError(f"robot state: ({pose.x_m}, {pose.y_m}) is inside a wall")
        velocity = (_number(state, key) for key in ("forward_m_s", "left_m_s", "turn_rad_s"))
        times = [_number(state, key) for key in ("time_s", "winding_rad", "lap_start_rad")]
        laps = [int(_number(state, key)) for key in ("laps_left", "laps_right")]
        self._pose, self._velocity = pose, Velocity(*velocity)
        self._time_s, self._winding_rad, self._lap_start_rad = times
        self._left, self._right = laps

    def close(self) -> None:
        """Free the simulation. May be called twice."""
        self._velocity = STANDSTILL
        self._scene.close()

    def _substeps(self, duration_s: float) -> int:
        v = self._velocity
        way = math.hypot(v.forward_m_s, v.left_m_s) * duration_s / SUBSTEP_M
        turn = abs(v.turn_rad_s) * duration_s / SUBSTEP_RAD
        return max(1, math.ceil(max(way, turn) - 1e-9))

    def _substep(self, duration_s: float, free: float) -> float:
        """Move as far as walls allow; return a lower bound of the gap, exact near walls."""
        before = self._pose
        after = advance(before, self._velocity, duration_s)
        way = math.hypot(after.x_m - before.x_m, after.y_m - before.y_m)
        free -= way
        if free <= SKIN_M:
            free = self._clearance(after)
        if free < GAP_M and way > 0.0:
            after, free = self._blocked(before, after)
        self._pose = after
        self._count_laps(before, after)
        return free

    def _blocked(self, before: Pose, after: Pose) -> tuple[Pose, float]:
        """Turn as commanded, and move up to the wall but not into it."""
        x, y = before.x_m, before.y_m
        part = 1.0
        for _ in range(_HALVINGS):
            part /= 2.0
            nearer = Pose(
                x + part * (after.x_m - before.x_m),
                y + part * (after.y_m - before.y_m),
                after.heading_rad,
            )
            if self._clearance(nearer) >= GAP_M:
                x, y = nearer.x_m, nearer.y_m
        pose = Pose(x, y, after.heading_rad)
        return pose, min(self._clearance(pose), SKIN_M)

    def _count_laps(self, before: Pose, after: Pose) -> None:
        if self.world.lap is None:
            return
        cx, cy = self.world.lap.centre
        now = math.atan2(after.y_m - cy, after.x_m - cx)
        self._winding_rad += wrap(now - math.atan2(before.y_m - cy, before.x_m - cx))
        progress = self._winding_rad - self._lap_start_rad
        if abs(progress) >= 2.0 * math.pi:
            self._lap_start_rad += math.copysign(2.0 * math.pi, progress)
            if progress > 0.0:
                self._left += 1
            else:
                self._right += 1

    def _clearance(self, pose: Pose) -> float:
        return self._scene.clearance(pose.x_m, pose.y_m)

    def _inside(self, pose: Pose) -> bool:
        return bool(self.world.free(np.array([[pose.x_m, pose.y_m]]))[0])


def _number(state: dict[str, float | int | str], key: str) -> float:
    value = state[key]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"robot state: {key} must be a finite number, got {value!r}")
    return float(value)
