"""Driving without learning: the same starts for whoever drives, what happened, figures of it.

The network is frozen and acts greedily. `planner` and `random` drive through the same code and are
the ceiling and the floor.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from experiments.drives.choosers import Chooser
from experiments.drives.places import SEED, first_start, free_cells, start_poses
from experiments.drives.traces import Figures, Trace, figures
from experiments.environment import CorridorEnv
from services.robot_driver.robot import Pose
from shared.messages import Observation
from shared.rl.draws import generator

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
    traces = [drive(env, choose, n, pose, actions) for n, pose in enumerate(poses)]
    return Evaluation(traces, figures_of(env, traces))


def figures_of(env: CorridorEnv, traces: Sequence[Trace]) -> Figures:
    """Figures of drives in the environment's world."""
    config = env.config
    cells = free_cells(env.world, config.robot.radius_m)
    return figures(traces, cells, config.episode.horizon, config.max_distance_m)


def drive_from_first_start(env: CorridorEnv, choose: Chooser, actions: int = ACTIONS) -> Trace:
    """The one drive that tells whether a first lap is driven (`traces.first_lap`)."""
    return drive(env, choose, 0, first_start(env.robot.world), actions)


def drive(env: CorridorEnv, choose: Chooser, number: int, pose: Pose, actions: int) -> Trace:
    """Drive this many actions from a pose. After a bump the driver recovers as always.

    Args:
        env: Without a wrapper.
        choose: Who drives.
        number: Seeds the draws of recoveries and of `choose`.
        pose: Where to begin, standing.
        actions: How many, at least 1.
    """
    observation: Observation = env.reset(seed=number, options={"pose": pose})[1]["observation"]
    draw = generator(SEED, "action", number)
    bumps, way_m = np.zeros(actions, np.bool_), np.zeros(actions)
    poses = np.zeros((actions + 1, 3))
    poses[0] = pose.x_m, pose.y_m, pose.heading_rad
    for i in range(actions):
        _, _, bumps[i], _, info = env.step(np.int64(choose(observation, draw)))
        reached = env.robot.pose
        way_m[i] = math.hypot(reached.x_m - poses[i, 0], reached.y_m - poses[i, 1])
        if bumps[i]:
            _, info = env.reset()
        observation = info["observation"]
        poses[i + 1] = observation.x_m, observation.y_m, observation.heading_rad
    laps = env.robot.laps
    return Trace(
        world=env.robot.world.name,
        bumps=bumps,
        places_m=poses[:, :2],
        headings_rad=poses[:, 2],
        way_m=way_m,
        laps_left=laps.left,
        laps_right=laps.right,
    )
