"""The simulated robot: kinematic motion in small steps, a ring bumper and a camera (A1, A2).

What happens next depends on `state()` alone: on world and obstacles, pose, velocity, time and laps.
PyBullet is only asked how far the nearest wall or obstacle is and what the camera sees, so a robot
restored in another process continues bit for bit. Between actions the world may be changed:
obstacles placed and removed, or another world put in its place.
"""

import copy
import json
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from pydantic import TypeAdapter, ValidationError

from services.robot_driver.robot import (
    STANDSTILL,
    ChangeableWorld,
    Felt,
    Laps,
    Pose,
    Robot,
    Sensed,
    Velocity,
)
from services.robot_driver.simulated.kinematics import LapCounter, advance, wrap
from services.robot_driver.simulated.scene import Scene
from services.robot_driver.simulated.world import World, WorldError, load_world
from services.robot_driver.simulated.world_parts import Obstacle, Start
from shared.config import RobotConfig
from shared.rl.preprocess import preprocess

SUBSTEP_M = 0.01
"""Longest way between two looks at the walls: far below their thickness."""
SUBSTEP_RAD = math.radians(5.0)
SKIN_M = 0.001
"""The bumper is pressed while the gap to a wall is at most this."""
GAP_M = 0.0002
"""The shell never comes nearer to a wall than this."""
_OBSTACLES = TypeAdapter(tuple[Obstacle, ...])
_HALVINGS = 6
"""How often a substep that would touch is halved: what is left is well inside the skin."""


class SimRobot(Robot):
    """A Robotino in a world, as `robot.Robot`; deterministic and without noise.

    It begins at the first start pose. `seed` is for worlds with chance in them; there is none yet.

    Raises ValueError when the start pose touches a wall.
    """

    def __init__(self, config: RobotConfig, world: World, seed: int) -> None:
        self.config = config
        self.world = world
        self.seed = seed
        self.obstacles = world.obstacles
        """What stands in the world now, in the order in which it was placed."""
        self.pose = _pose_of(world.starts[0])
        """Where the robot is; without the cost of a picture."""
        self._velocity = STANDSTILL
        self._time_s = 0.0
        self._laps = LapCounter()
        self._scene = self._at_start(world, 0)

    @property
    def contact(self) -> bool:
        """The ring bumper is pressed now, anywhere on the ring."""
        return self._clearance(self.pose) <= SKIN_M

    @property
    def laps(self) -> Laps:
        """Laps so far."""
        return self._laps.laps

    @property
    def changeable(self) -> ChangeableWorld:
        """The robot itself: its world can be changed."""
        return self

    def frame(self, width_px: int = 0, height_px: int = 0) -> npt.NDArray[np.uint8]:
        """The camera picture before preprocessing: uint8 [h, w, 3], RGB."""
        return self.look_from(self.pose, width_px, height_px)

    def look_from(self, pose: Pose, width_px: int = 0, height_px: int = 0) -> npt.NDArray[np.uint8]:
        """What the camera would see from another pose; the robot stays where it is."""
        return self._scene.frame(pose, width_px, height_px)

    def sense(self) -> Sensed:
        """Camera, pose and bumper now."""
        return Sensed(self.pose, self.contact, preprocess(self.frame()))

    def feel(self) -> Felt:
        """Pose and bumper now, without a picture."""
        return Felt(self.pose, self.contact)

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
        free = self._clearance(self.pose)
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

    def place(self, obstacle: Obstacle) -> None:
        """Let a box stand in the world from now on.

        Raises:
            ValueError: One of that name stands there, it does not fit into the world, it overlaps
                the robot, or there are too many. Nothing has changed then.
        """
        self.world.check_placing(obstacle, [other.name for other in self.obstacles])
        obstacles = (*self.obstacles, obstacle)
        complaint = f"obstacle {obstacle.name!r} would overlap the robot"
        self._show(self._built(self.world, obstacles, self.pose, GAP_M, complaint))
        self.obstacles = obstacles

    def remove(self, name: str) -> None:
        """Take an obstacle away. Raises ValueError when there is none of that name."""
        obstacles = tuple(other for other in self.obstacles if other.name != name)
        if len(obstacles) == len(self.obstacles):
            raise ValueError(f"there is no obstacle {name!r}")
        self._show(Scene(self.world, self.config.radius_m, self.config.camera, obstacles))
        self.obstacles = obstacles

    def switch(self, world: World, start: int = 0) -> None:
        """Stand still at a start pose of another world; its laps count on from the old ones'.

        Raises ValueError: no such start pose, or it touches something. Nothing has changed then.
        """
        world.check_start(start)
        self._show(self._at_start(world, start))
        self.world, self.obstacles = world, world.obstacles
        self.pose, self._velocity = _pose_of(world.starts[start]), STANDSTILL
        self._laps = LapCounter(left=self._laps.left, right=self._laps.right)

    def state(self) -> dict[str, float | int | str]:
        """Everything that decides what happens next."""
        return {
            "world": self.world.name,
            "world_fingerprint": self.world.fingerprint,
            "obstacles": json.dumps([obstacle.model_dump() for obstacle in self.obstacles]),
            "x_m": self.pose.x_m,
            "y_m": self.pose.y_m,
            "heading_rad": self.pose.heading_rad,
            "forward_m_s": self._velocity.forward_m_s,
            "left_m_s": self._velocity.left_m_s,
            "turn_rad_s": self._velocity.turn_rad_s,
            "time_s": self._time_s,
            "winding_rad": self._laps.winding_rad,
            "lap_start_rad": self._laps.lap_start_rad,
            "laps_left": self._laps.left,
            "laps_right": self._laps.right,
        }

    def restore(self, state: dict[str, float | int | str]) -> None:
        """Continue from `state()`, in its world.

        Raises:
            ValueError: A world that is not there or has changed, a missing or wrong value, or a
                pose inside a wall or an obstacle. The robot is unchanged then.
        """
        if set(state) != set(self.state()):
            odd = sorted(set(state) ^ set(self.state()))
            raise ValueError(f"robot state: missing or unknown {', '.join(odd)}")
        world, obstacles = self._world_of(state), _obstacles_of(state)
        pose = Pose(*(_number(state, key) for key in ("x_m", "y_m", "heading_rad")))
        speeds = ("forward_m_s", "left_m_s", "turn_rad_s")
        velocity = Velocity(*(_number(state, key) for key in speeds))
        time_s = _number(state, "time_s")
        winding_rad, lap_start_rad = _number(state, "winding_rad"), _number(state, "lap_start_rad")
        left, right = int(_number(state, "laps_left")), int(_number(state, "laps_right"))
        self._put(world, obstacles, pose)
        self.pose, self._velocity = pose, velocity
        self._time_s = time_s
        self._laps = LapCounter(winding_rad, lap_start_rad, left, right)

    def twin(self) -> "SimRobot":
        """Another robot in the same state, that drives on by itself; neither meets the other.

        Both ask one scene as long as the world of neither is changed, and each is to be closed.
        """
        twin = copy.copy(self)
        twin._scene = self._scene.shared()
        twin._laps = replace(self._laps)
        return twin

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
        before = self.pose
        after = advance(before, self._velocity, duration_s)
        way = math.hypot(after.x_m - before.x_m, after.y_m - before.y_m)
        free -= way
        if free <= SKIN_M:
            free = self._clearance(after)
        if free < GAP_M and way > 0.0:
            after, free = self._blocked(before, after)
        self.pose = after
        if self.world.lap is not None:
            self._laps.add(self.world.lap.centre, before, after)
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

    def _clearance(self, pose: Pose) -> float:
        return self._scene.clearance(pose.x_m, pose.y_m)

    def _built(
        self,
        world: World,
        obstacles: Sequence[Obstacle],
        pose: Pose,
        least_gap_m: float,
        complaint: str,
    ) -> Scene:
        """A scene where a robot at this pose keeps that gap; else a ValueError with `complaint`."""
        scene = Scene(world, self.config.radius_m, self.config.camera, obstacles)
        if scene.clearance(pose.x_m, pose.y_m) < least_gap_m:
            scene.close()
            raise ValueError(complaint)
        return scene

    def _at_start(self, world: World, start: int) -> Scene:
        pose = _pose_of(world.starts[start])
        complaint = f"world {world.name!r}: starts.{start} touches a wall or an obstacle"
        return self._built(world, world.obstacles, pose, SKIN_M, complaint)

    def _show(self, scene: Scene) -> None:
        self._scene.close()
        self._scene = scene

    def _put(self, world: World, obstacles: tuple[Obstacle, ...], pose: Pose) -> None:
        """Be in this world; the pose is not taken up but must be possible there."""
        complaint = f"robot state: ({pose.x_m}, {pose.y_m}) is inside a wall or an obstacle"
        if not bool(world.between_walls(np.array([[pose.x_m, pose.y_m]]))[0]):
            raise ValueError(complaint)
        if (world, obstacles) != (self.world, self.obstacles):
            self._show(self._built(world, obstacles, pose, GAP_M, complaint))
            self.world, self.obstacles = world, obstacles
        elif self._clearance(pose) < GAP_M:
            raise ValueError(complaint)

    def _world_of(self, state: dict[str, float | int | str]) -> World:
        """The world that the state was saved in: the one at hand, or another that comes along."""
        try:
            same = state["world_fingerprint"] == self.world.fingerprint
            world = self.world if same else load_world(str(state["world"]))
        except WorldError as error:
            raise ValueError(f"robot state: {error}") from error
        if state["world_fingerprint"] != world.fingerprint:
            raise ValueError(f"robot state: is of another world {world.name!r} than there is now")
        return world


def _pose_of(start: Start) -> Pose:
    return Pose(start.x_m, start.y_m, wrap(math.radians(start.heading_deg)))


def _obstacles_of(state: dict[str, float | int | str]) -> tuple[Obstacle, ...]:
    try:
        return _OBSTACLES.validate_json(str(state["obstacles"]))
    except ValidationError as error:
        raise ValueError(f"robot state: obstacles: {error.errors()[0]['msg']}") from error


def _number(state: dict[str, float | int | str], key: str) -> float:
    value = state[key]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"robot state: {key} must be a finite number, got {value!r}")
    return float(value)
