"""Reward equalisation (section 3.5.2, Eq 3.5): old rewards move towards current predictions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from shared.rl.reward import TERMINAL_REWARD

if TYPE_CHECKING:
    from shared.config import MemoryConfig

Floats = npt.NDArray[np.float32]


def equalised(rewards: Floats, values: Floats, config: MemoryConfig) -> Floats:
    """Eq 3.5: r <- keep r + (1 - keep) Q(s, a), clipped to [-1, 1].

    rewards, values: float32 [n], the latter clipped predictions of the target network for each
    stored action. Terminal samples drift too unless `protect_terminal` (E24); no other sample can
    have the reward -1 (E7).
    """
    keep = np.float32(config.equalise_keep)
    fresh = np.clip(keep * rewards + (np.float32(1.0) - keep) * values, -1.0, 1.0)
    if config.protect_terminal:
        fresh = np.where(rewards == np.float32(TERMINAL_REWARD), rewards, fresh)
    return fresh.astype(np.float32)
