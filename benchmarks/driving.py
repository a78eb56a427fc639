"""Driving without learning: seeded starts in both directions, what happened, figures of it.

Circling on the spot bumps into nothing. That is why bumps never stand alone here: the distance from
where the robot was some actions ago and the laps tell whether it gets anywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from experiments.single_process import LIFE
from services.robot_driver.driver import Driver
from services.robot_driver.robot import Pose
from services.robot_driver.sim import SimRobot
from services.robot_driver.world import World
from shared.config import Config, PolicyConfig
from shared.messages import ImageArray, image_array
from shared.rl.draws import generator
from shared.rl.policy import choose, choose_uniformly
from shared.rl.predictor import Predictor

Chooser = Callable[[ImageArray, np.random.Generator], int]
"""Chooses an action for an image."""
Figures = dict[str, float]

SEED = 7
"""Of starts, recoveries and random actions: the same for whoever is tried."""
ROOM_M = 0.8
"""Starts keep this to all walls: each can be driven on from."""
JITTER_RAD = math.radians(20.0)
"""Largest angle between a start's heading and the nearest wall."""
GREEDY = PolicyConfig(kind="eps-greedy", epsilon=0.0)


@dataclass(frozen=True)
class Trace:
    """What happened on one drive."""

    bumps: npt.NDArray[np.bool_]
    """[actions]: whether there was contact."""
    places_m: npt.NDArray[np.float64]
    """[actions + 1, 2]: x, y before the first action and after each, recovery included."""
    laps_left: int
    laps_right: int


def start_poses(world: World, count: int) -> list[Pose]:
    """Poses along the corridor, by turns anticlockwise and clockwise round the lap centre."""
    draw = generator(SEED, "start")
    x0, y0, x1, y1 = world.bounds
    poses: list[Pose] = []
    while len(poses) < count:
        point = draw.uniform((x0, y0), (x1, y1))
        heading = _anticlockwise(world, point) + math.pi * (len(poses) % 2)
        heading += draw.uniform(-JITTER_RAD, JITTER_RAD)
        if world.clearance(point[None, :])[0] >= ROOM_M:
            turned = math.remainder(heading, 2.0 * math.pi)
            poses.append(Pose(float(point[0]), float(point[1]), turned))
    return poses


def greedy(predictor: Predictor) -> Chooser:
    """The best action by the predictions, exact ties drawn."""
    return lambda image, draw: choose(predictor.all_values(image[None])[0], GREEDY, draw)[0]


def uniform(image: ImageArray, draw: np.random.Generator) -> int:  # noqa: ARG001
    """Any action: the floor."""
    return choose_uniformly(draw)


def drives(config: Config, robot: SimRobot, chooser: Chooser, n: int, actions: int) -> list[Trace]:
    """As many actions from each of n starts."""
    poses = start_poses(robot.world, n)
    return [drive(config, robot, chooser, start, poses[start], actions) for start in range(n)]


def drive(
    config: Config, robot: SimRobot, chooser: Chooser, number: int, pose: Pose, actions: int
) -> Trace:
    """One drive from a pose; after a bump the driver recovers as always. `number` seeds draws."""
    place(robot, pose)
    seeded = config.model_copy(update={"run": config.run.model_copy(update={"seed": number})})
    driver = Driver(seeded, robot, LIFE)
    draw = generator(SEED, "action", number)
    bumps = np.zeros(actions, np.bool_)
    places_m = np.zeros((actions + 1, 2))
    places_m[0] = pose.x_m, pose.y_m
    for i in range(actions):
        before = driver.bumps
        driver.execute(chooser(image_array(driver.observe().image), draw))
        bumps[i] = driver.bumps > before
        places_m[i + 1] = robot.pose.x_m, robot.pose.y_m
    return Trace(bumps, places_m, robot.laps.left, robot.laps.right)


def place(robot: SimRobot, pose: Pose) -> None:
    """Put the robot somewhere, standing, its laps forgotten."""
    fresh = {key: value if isinstance(value, str) else 0 for key, value in robot.state().items()}
    robot.restore(fresh | {"x_m": pose.x_m, "y_m": pose.y_m, "heading_rad": pose.heading_rad})


def figures(traces: Sequence[Trace], horizon: int, max_distance_m: float) -> Figures:
    """Bumps, bump-free runs, distance and laps of drives.

    A run is what lies between two bumps, or a bump and an end of its drive, without the bumping
    action. The distance is that from `horizon` actions ago, relative to the farthest possible.
    """
    actions = sum(len(trace.bumps) for trace in traces)
    bumps = sum(int(trace.bumps.sum()) for trace in traces)
    runs = [run for trace in traces for run in bump_free_runs(trace.bumps)]
    far_m = np.concatenate([distances_m(trace.places_m, horizon) for trace in traces])
    return {
        "actions": actions,
        "bumps": bumps,
        "bumps_per_1000": 1000.0 * bumps / actions,
        "mean_run": float(np.mean(runs)),
        "longest_run": max(runs),
        "distance": float(far_m.mean()) / max_distance_m,
        "laps_left": sum(trace.laps_left for trace in traces),
        "laps_right": sum(trace.laps_right for trace in traces),
    }


def bump_free_runs(bumps: npt.NDArray[np.bool_]) -> list[int]:
    """Lengths of the bump-free runs of a drive; one cut off by its end counts if it began."""
    ends = np.flatnonzero(bumps)
    lengths = np.diff(ends, prepend=-1) - 1
    rest = len(bumps) - (int(ends[-1]) + 1 if len(ends) else 0)
    return [*map(int, lengths), *([rest] if rest else [])]


def distances_m(places_m: npt.NDArray[np.float64], horizon: int) -> npt.NDArray[np.float64]:
    """How far the robot is from where it was `horizon` actions ago, as soon as there is one."""
    way = places_m[horizon:] - places_m[: max(len(places_m) - horizon, 0)]
    return np.asarray(np.hypot(way[:, 0], way[:, 1]))


def _anticlockwise(world: World, point: npt.NDArray[np.float64]) -> float:
    """Direction of the nearest wall, as an anticlockwise lap passes it.

    Free space lies on the left of walls: the boundary, which comes first, runs anticlockwise,
    islands run clockwise.
    """
    start, end = world.segments[:, :2], world.segments[:, 2:]
    along = end - start
    part = ((point - start) * along).sum(axis=1) / (along**2).sum(axis=1)
    gap = point - (start + np.clip(part, 0.0, 1.0)[:, None] * along)
    nearest = int(np.argmin((gap**2).sum(axis=1)))
    sense = 1.0 if nearest < len(world.walls[0].points) else -1.0
    return math.atan2(sense * along[nearest, 1], sense * along[nearest, 0])
