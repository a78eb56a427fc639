"""Driving without learning: the same starts for whoever drives, what happened, figures of it.

The robots drive side by side, so that the network predicts for many of them at once. It is frozen
and acts greedily. `planner` and `random` drive through the same code and are the ceiling and the
floor. They depend on world, robot and starts alone: they are driven once and kept beside the runs.
"""

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.drives.choosers import Chooser, Planned, uniform
from experiments.drives.places import SEED, first_start, free_cells, start_poses
from experiments.drives.traces import Figures, Trace, figures
from experiments.environment import CorridorEnv
from services.robot_driver.robot import Pose
from shared.messages import Observation
from shared.rl.draws import generator
from shared.statefile import write_atomically

STARTS, ACTIONS = 16, 400
"""How many drives, and of how many actions each, unless told otherwise."""


@dataclass(frozen=True)
class Evaluation:
    """Drives from all starts, and their figures."""

    traces: list[Trace]
    figures: Figures
    """Named as in `records.EVALUATION_COLUMNS`, from `actions` to `circling`."""


def evaluate(
    env: CorridorEnv, choose: Chooser, starts: int = STARTS, actions: int = ACTIONS
) -> Evaluation:
    """Drive from all starts of the environment's world. The robot stands elsewhere afterwards."""
    poses = start_poses(env.world, env.config.robot.radius_m, starts)
    traces = drive(env, choose, poses, actions)
    return Evaluation(traces, figures_of(env, traces))


def figures_of(env: CorridorEnv, traces: Sequence[Trace]) -> Figures:
    """Figures of drives in the environment's world."""
    config = env.config
    cells = free_cells(env.world, config.robot.radius_m)
    return figures(traces, cells, config.episode.horizon, config.max_distance_m)


def drive_from_first_start(env: CorridorEnv, choose: Chooser, actions: int = ACTIONS) -> Trace:
    """The one drive that tells whether a first lap is driven (`traces.first_lap`)."""
    return drive(env, choose, [first_start(env.robot.world)], actions)[0]


def drive(env: CorridorEnv, choose: Chooser, poses: Sequence[Pose], actions: int) -> list[Trace]:
    """Drive from several poses side by side, as if each robot were the only one; a trace for each.

    The robots act in turn, in one scene, and none is in another's way. What one does depends only
    on its pose, its number among the poses, which seeds its draws, and who drives. After a bump the
    driver recovers as always.

    env: Without a wrapper. Its own robot drives from the first pose, twins from the others.

    Raises ValueError for a pose inside a wall.
    """
    with ExitStack() as twins:
        drives: list[Drive] = []
        for number, pose in enumerate(poses):
            twin = CorridorEnv(config=env.config, robot=env.robot.twin()) if number else None
            drives.append(Drive(twins.enter_context(twin) if twin else env, number, pose))
        draws = [generator(SEED, "action", number) for number in range(len(poses))]
        for _ in range(actions):
            chosen = choose([each.observation for each in drives], draws)
            for each, action in zip(drives, chosen, strict=True):
                each.act(action)
        return [each.trace() for each in drives]


class Drive:
    """One robot on its drive, and what happened so far."""

    def __init__(self, env: CorridorEnv, number: int, pose: Pose) -> None:
        """Stand the robot there; `number` seeds its recoveries."""
        self._env = env
        env.reset(seed=number, options={"pose": pose})
        self.observation: Observation = env.seen
        """What the next action is chosen by."""
        self._poses = [(pose.x_m, pose.y_m, pose.heading_rad)]
        self.bumps: list[bool] = []
        """Whether there was contact, by action or turn."""
        self._way_m: list[float] = []

    def act(self, action: int) -> bool:
        """Carry out an action, recovery included; whether it bumped."""
        bumped = self._env.step(np.int64(action))[2]
        reached, (x_m, y_m, _) = self._env.robot.pose, self._poses[-1]
        way_m = math.hypot(reached.x_m - x_m, reached.y_m - y_m)
        if bumped:
            self._env.reset()
        self._note(self._env.seen, bumped, way_m)
        return bumped

    def turn(self, *, left: bool) -> None:
        """Turn on the spot for the time of one action."""
        self._note(self._env.turn(left), False, 0.0)

    def _note(self, seen: Observation, bumped: bool, way_m: float) -> None:
        self.observation = seen
        self._poses.append((seen.x_m, seen.y_m, seen.heading_rad))
        self.bumps.append(bumped)
        self._way_m.append(way_m)

    def trace(self) -> Trace:
        """The drive so far."""
        laps, poses = self._env.robot.laps, np.array(self._poses)
        return Trace(
            world=self._env.robot.world.name,
            bumps=np.array(self.bumps, np.bool_),
            places_m=poses[:, :2],
            headings_rad=poses[:, 2],
            way_m=np.array(self._way_m),
            laps_left=laps.left,
            laps_right=laps.right,
        )


_CHOOSERS: dict[str, Callable[[CorridorEnv], Chooser]] = {
    "random": lambda _: uniform,
    "planner": lambda env: Planned(env.robot.world, env.config.robot),
}
DRIVERS = tuple(_CHOOSERS)


def reference(env: CorridorEnv, driver: str, starts: int, actions: int, kept: Path) -> Figures:
    """Figures of a driver that learns nothing, from the folder `kept` where they are known."""
    path = kept / f"{driver}-{env.robot.world.name}-{_key(env, starts, actions)}.json"
    if path.is_file():
        return {str(key): float(value) for key, value in json.loads(path.read_text()).items()}
    figures = evaluate(env, _CHOOSERS[driver](env), starts, actions).figures
    write_atomically(path, json.dumps(figures).encode())
    return figures


def _key(env: CorridorEnv, starts: int, actions: int) -> str:
    """8 hex digits over everything that decides the figures."""
    decides = {
        "robot": env.config.robot.model_dump(mode="json"),
        "horizon": env.config.episode.horizon,
        "world": env.robot.world.fingerprint,
        "drives": [starts, actions],
    }
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:8]
