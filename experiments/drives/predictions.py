"""How well predicted rewards agree with what then happens, on drives that nothing learns from.

The robot explores as while learning: one action in ten is any. What it observes gives the reward of
each action afresh (Eq 3.1), beside the prediction it had. A network whose rewards have all become
alike still ranks actions well now and then; how far its predictions reach shows it.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy import stats

from experiments.drives.choosers import Predicts
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
    noted: list[tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]] = []

    def explore(
        observations: Sequence[Observation], draws: Sequence[np.random.Generator]
    ) -> list[int]:
        values = network.all_values(np.stack([image_array(seen.image) for seen in observations]))
        pairs = zip(values, draws, strict=True)
        chosen = [choose(mine, EXPLORING, draw)[0] for mine, draw in pairs]
        noted.append((values, np.array(chosen)))
        return chosen

    poses = start_poses(env.world, env.config.robot.radius_m, starts)
    traces = drive(env, explore, poses, actions)
    values, chosen = (np.stack(column, axis=1) for column in zip(*noted, strict=True))
    drives = zip(traces, values, chosen, strict=True)
    return figures(np.concatenate([judged(*each, env.config) for each in drives], axis=1))


def figures(found: Floats) -> Figures:
    """The three figures of `prediction_figures`, of what `judged` found."""
    nan = float("nan")
    predicted, observed, before_wall = found
    tells = len(predicted) > 2 and np.ptp(predicted) > 0.0 and np.ptp(observed) > 0.0
    near = predicted[before_wall > 0.0]
    return {
        "wall_value": float(near.mean()) if len(near) else nan,
        "value_rank": float(stats.spearmanr(predicted, observed).statistic) if tells else nan,
        "value_slope": float(np.polyfit(predicted, observed, 1)[0]) if tells else nan,
    }


def judged(
    trace: Trace, values: npt.NDArray[np.float32], chosen: npt.NDArray[np.int64], config: Config
) -> Floats:
    """Predictions and rewards of one drive, as far as what followed was seen.

    Args:
        trace: The drive of n actions.
        values: float32 [n, actions]: clipped predictions before each action.
        chosen: [n]: the actions.
        config: Horizon and weights of the reward.

    Returns:
        float64 [3, k]: Q of each action, its reward by Eq 3.1 from what followed, and 1 where it
        hit a wall within 6 actions, else 0.
    """
    n, horizon = len(chosen), config.episode.horizon
    predicted = values[np.arange(n), chosen].astype(np.float64)
    parts, start = [np.zeros((3, 0))], 0
    for end in dict.fromkeys([*(np.flatnonzero(trace.bumps) + 1).tolist(), n]):
        bump = bool(trace.bumps[end - 1])
        seen = np.arange(start, end if bump else max(end - horizon, start))
        if len(seen):
            rewards = episode_rewards(
                trace.places_m[start:end],
                values[np.minimum(seen + 1, n - 1)].max(axis=1).astype(np.float64),
                bump=bump,
                horizon=horizon,
                max_distance_m=config.max_distance_m,
                config=config.reward,
            )
            near = (end - 1 - seen < BEFORE_WALL) & bump
            parts.append(np.stack([predicted[seen], rewards.astype(np.float64), near]))
        start = end
    return np.concatenate(parts, axis=1)
