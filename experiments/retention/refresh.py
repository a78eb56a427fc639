"""Ways to refresh rewards that were observed long ago (section 3.5.2), compared on streams.

A stored reward holds 0.2 max Q of the next image as an early network saw it, and the way that an
early policy went in the 50 actions that followed. Equalisation (Eq 3.5) moves it towards what the
network predicts now.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from experiments.retention.stream import Stream
from shared.config import MemoryConfig
from shared.rl.equalisation import equalised
from shared.rl.memory import ReplayMemory
from shared.rl.predictor import Predictor
from shared.rl.turn import current_values

Way = Literal["none", "blend", "protected", "anchored"]
"""none: rewards stay as observed.
blend: Eq 3.5 as it is, again and again from the reward as it is now.
protected: the same, but -1 stays (E24).
anchored: always from the reward as it was first observed.
"""


def refresh(
    way: Way, memory: ReplayMemory, stream: Stream, network: Predictor, config: MemoryConfig
) -> None:
    """Change the rewards of a memory of samples of a stream; `config` tells what Eq 3.5 keeps."""
    if way == "none":
        return
    rewards = memory.rows["reward"]
    if way == "anchored":
        rewards = stream.samples["reward"][memory.ids.astype(np.int64) - 1]
    if way == "protected":
        config = config.model_copy(update={"protect_terminal": True})
    memory.rows["reward"] = equalised(rewards, current_values(memory, network), config)
