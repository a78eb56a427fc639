"""How well predicted rewards agree with what then happens, on drives that nothing learns from.

The robot explores as while learning: one action in ten is any. What it observes gives the reward of
each action afresh (Eq 3.1), beside the prediction it had. A network whose rewards have all become
alike still ranks actions well now and then; how far its predictions reach shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import stats

from experiments.drives.choosers import Chooser, Predicts
from experiments.drives.frozen_drives import drive
from experiments.drives.places import start_poses
from experiments.drives.traces import Figures, Trace
from experiments.environment import CorridorEnv
from shared.config import Config, PolicyConfig
from shared.messages import Observation, image_array
from shared.rl.policy import choose
from shared.rl.reward import episode_rewards

Floats = npt.NDArray[np.float64]
EXPLORING = PolicyConfig(kind="eps-greedy", epsilon=0.1)
BEFORE_WALL = 6
"""An action hits a wall soon if the robot bumps within so many actions, itself counted."""


class Judged(NamedTuple):
    """Predictions of actions that were carried out, and what came of them."""

    predicted: Floats
    """[n]: Q of the action."""
    observed: Floats
    """[n]: its reward by Eq 3.1, from what followed."""
    before_wall: npt.NDArray[np.bool_]
    """[n]: whether it hit a wall within 6 actions."""


def prediction_figures(env: CorridorEnv, network: Predicts, starts: int, actions: int) -> Figures:
    """Drive and compare predictions with what followed.

    Args:
        env: The robot's world. It stands elsewhere afterwards.
        network: Frozen.
        starts: Number of drives.
        actions: Of each drive, more than the horizon of the reward.

    Returns:
        wall_value: mean Q of actions that hit a wall within 6 actions.
        value_rank: rank correlation of Q with the reward observed (Spearman).
        value_slope: slope of the reward over Q; 1 where predictions reach as far as rewards.
        NaN where there are too few actions to tell.
    """
    noting = _Noting(network)
    poses = start_poses(env.world, env.config.robot.radius_m, starts)
    traces = drive(env, noting.choose, poses, actions)
    values = np.stack(noting.values, axis=1)  # [starts, actions, actions of the robot]
    chosen = np.stack(noting.chosen, axis=1)
    parts = [
        judged(trace, own, took, env.config)
        for trace, own, took in zip(traces, values, chosen, strict=True)
    ]
    return figures(Judged(*(np.concatenate(column) for column in zip(*parts, strict=True))))


def figures(found: Judged) -> Figures:
    """The three figures of `prediction_figures`."""
    nan = float("nan")
    tells = len(found.predicted) > 2 and all(np.ptp(values) > 0.0 for values in found[:2])
    near = found.predicted[found.before_wall]
    return {
        "wall_value": float(near.mean()) if len(near) else nan,
        "value_rank": float(stats.spearmanr(*found[:2]).statistic) if tells else nan,
        "value_slope": float(np.polyfit(*found[:2], 1)[0]) if tells else nan,
    }


def judged(
    trace: Trace, values: npt.NDArray[np.float32], chosen: npt.NDArray[np.int64], config: Config
) -> Judged:
    """Predictions and rewards of one drive, as far as what followed was seen.

    Args:
        trace: The drive of n actions.
        values: float32 [n, actions]: clipped predictions before each action.
        chosen: [n]: the actions.
        config: Horizon and weights of the reward.
    """
    predicted = values[np.arange(len(chosen)), chosen].astype(np.float64)
    nothing = Judged(np.zeros(0), np.zeros(0), np.zeros(0, np.bool_))
    parts = [nothing]
    for start, end in _stretches(trace.bumps):
        bump = bool(trace.bumps[end - 1])
        count = end - start if bump else end - start - config.episode.horizon
        if count > 0:
            stretch = slice(start, end)
            parts.append(_between(trace, predicted, values, stretch, count, config))
    return Judged(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _stretches(bumps: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Actions from one recovery to the next bump, that one included, and the rest."""
    ends = [int(end) + 1 for end in np.flatnonzero(bumps)]
    if not ends or ends[-1] < len(bumps):
        ends.append(len(bumps))
    return list(zip([0, *ends[:-1]], ends, strict=True))


def _between(
    trace: Trace,
    predicted: Floats,
    values: npt.NDArray[np.float32],
    stretch: slice,
    count: int,
    config: Config,
) -> Judged:
    """The first `count` actions of a stretch: those whose look-ahead was seen."""
    start, end = stretch.start, stretch.stop
    bump = bool(trace.bumps[end - 1])
    following = np.minimum(np.arange(start, start + count) + 1, len(values) - 1)
    rewards = episode_rewards(
        trace.places_m[stretch],
        values[following].max(axis=1).astype(np.float64),
        bump=bump,
        horizon=config.episode.horizon,
        max_distance_m=config.max_distance_m,
        config=config.reward,
    )
    steps_to_end = np.arange(end - start - 1, end - start - 1 - count, -1)
    return Judged(
        predicted[start : start + count],
        rewards.astype(np.float64),
        (steps_to_end < BEFORE_WALL) & bump,
    )


class _Noting:
    """Explores, and notes what the network predicted and what was chosen."""

    def __init__(self, network: Predicts) -> None:
        self._network = network
        self.values: list[npt.NDArray[np.float32]] = []
        self.chosen: list[npt.NDArray[np.int64]] = []
        self.choose: Chooser = self._choose

    def _choose(
        self, observations: Sequence[Observation], draws: Sequence[np.random.Generator]
    ) -> list[int]:
        images = np.stack([image_array(seen.image) for seen in observations])
        values = self._network.all_values(images)
        pairs = zip(values, draws, strict=True)
        chosen = [choose(mine, EXPLORING, draw)[0] for mine, draw in pairs]
        self.values.append(values)
        self.chosen.append(np.array(chosen))
        return chosen
