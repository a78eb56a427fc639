"""Rewards of a finished episode (section 3.2, Eq 3.1-3.3), and later (section 3.5.2, Eq 3.5)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from shared.config import MemoryConfig, RewardConfig

Floats = npt.NDArray[np.float64]
Rewards = npt.NDArray[np.float32]
TERMINAL_REWARD = -1.0


def travelled(xy_m: Floats, last: npt.NDArray[np.int64], max_distance_m: float) -> Floats:
    """Eq 3.2: largest distance from p_t reached at t < i <= last[t], in units of max_distance_m.

    xy_m: [m, 2] positions in metres; last: [n] with n <= m and last[t] < m. Returns [n] in [0, 1]:
    0 where last[t] = t, clipped because odometry can overshoot (E5).
    """
    n = len(last)
    best = np.zeros(n)
    for ahead in range(1, int((last - np.arange(n)).max(initial=0)) + 1):
        t = np.flatnonzero(np.arange(n) + ahead <= last)
        step = xy_m[t + ahead] - xy_m[t]
        best[t] = np.maximum(best[t], np.hypot(step[:, 0], step[:, 1]))
    return np.clip(best / max_distance_m, 0.0, 1.0)


def bump_penalty(steps_to_bump: npt.NDArray[np.int64], decay: float, horizon: int) -> Floats:
    """Eq 3.3 with the sign of E2: -(decay^n) for n < horizon steps to the bump, else 0."""
    return np.where(steps_to_bump < horizon, -(decay ** steps_to_bump.astype(np.float64)), 0.0)


def episode_rewards(
    xy_m: Floats,
    next_max_q: Floats,
    *,
    bump: bool,
    horizon: int,
    max_distance_m: float,
    config: RewardConfig,
) -> Rewards:
    """Eq 3.1 for the samples an episode releases.

    xy_m: [m, 2] position at each sample in metres. next_max_q: [n] clipped max_a Q(s_{t+1}, a); its
    length n says how many samples are released. With `bump` the last sample is the terminal one
    (E6): n = m, reward -1, bypassing weights and Q (E7), and its next_max_q is ignored. Without,
    every released sample must have its full look-ahead: n + horizon <= m (E38), else ValueError.
    Returns float32 [n] in [-1, 1].
    """
    m, n = len(xy_m), len(next_max_q)
    t = np.arange(n)
    if bump:
        if n != m or n == 0:
            raise ValueError(f"a bump releases all samples: expected {m} (at least 1), got {n}")
        steps_to_bump = (n - 1) - t
        last = np.minimum(n - 1, t + horizon)
        penalty = bump_penalty(steps_to_bump, config.bump_decay, horizon)
    else:
        if n + horizon > m:
            raise ValueError(f"{n} samples need {n + horizon} positions to look ahead, got {m}")
        last = t + horizon
        penalty = np.zeros(n)
    observed = travelled(xy_m, last, max_distance_m) + penalty
    reward = config.observed_weight * observed + config.prediction_weight * next_max_q
    if bump:
        reward[-1] = TERMINAL_REWARD
    return np.clip(reward, -1.0, 1.0).astype(np.float32)


def equalised(rewards: Rewards, values: Rewards, config: MemoryConfig) -> Rewards:
    """Reward equalisation, Eq 3.5: r <- keep r + (1 - keep) Q(s, a), clipped to [-1, 1].

    rewards, values: float32 [n], the latter clipped predictions of the target network for each
    stored action. Terminal samples drift too unless `protect_terminal` (E24); no other sample can
    have the reward -1 (E7).
    """
    keep = np.float32(config.equalise_keep)
    fresh = np.clip(keep * rewards + (np.float32(1.0) - keep) * values, -1.0, 1.0)
    if config.protect_terminal:
        fresh = np.where(rewards == np.float32(TERMINAL_REWARD), rewards, fresh)
    return fresh.astype(np.float32)
