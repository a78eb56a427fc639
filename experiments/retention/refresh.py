"""Ways to refresh rewards that were observed long ago (section 3.5.2), compared on streams.

A stored reward holds 0.2 max Q of the next image as an early network saw it, and the way that an
early policy went in the 50 actions that followed. Equalisation (Eq 3.5) moves it towards what the
network predicts now.
"""

from collections.abc import Mapping
from typing import Literal

import numpy as np
import numpy.typing as npt

from experiments.retention.stream import Stream
from shared.config import Config, MemoryConfig
from shared.rl.memory import ReplayMemory
from shared.rl.predictor import Predictor
from shared.rl.reward import TERMINAL_REWARD, equalised

Floats = npt.NDArray[np.float32]
Way = Literal["none", "blend", "protected", "anchored", "next-value", "better-fits"]
"""none: rewards stay as observed.
blend: Eq 3.5 as it is, again and again from the reward as it is now.
protected: the same, but -1 stays (E24).
anchored: always from the reward as it was first observed.
next-value: only the part 0.2 max Q of the next image is made anew.
better-fits: Eq 3.5, but only after a fitting phase with a lower loss than the one before it.
"""
NEXT_M = 0.3
"""Two samples that follow each other are not farther apart than this."""


class Refresher:
    """Refreshes the rewards of a memory in one of the ways.

    Args:
        way: How.
        stream: Where the samples come from.
        config: Weights of the reward, and how much Eq 3.5 keeps.
        losses: Mean loss of the fitting phase behind each version of the network.
    """

    def __init__(
        self, way: Way, stream: Stream, config: Config, losses: Mapping[int, float]
    ) -> None:
        self._stream, self._config = stream, config
        self._refresh = {
            "none": self._none,
            "blend": self._blend,
            "protected": self._protected,
            "anchored": self._anchored,
            "next-value": self._next_value,
            "better-fits": self._better_fits,
        }[way]
        self._then = np.full(len(stream.samples), np.nan, np.float32)
        """max Q of each sample's next image when its reward was computed; NaN where not known."""
        self._fell = _fell(losses)
        self.needs_next = way == "next-value"

    def note(self, first: int, count: int, network: Predictor) -> None:
        """Note what the network in force expects after `count` new samples from this place on."""
        if self.needs_next:
            places = np.arange(first, first + count)
            self._then[places] = self._values_of_next(places, network)

    def refresh(self, memory: ReplayMemory, network: Predictor) -> None:
        """Change the rewards of a memory."""
        rewards = self._refresh(memory, network)
        memory.rows["reward"] = np.clip(rewards, -1.0, 1.0)

    def _none(self, memory: ReplayMemory, _: Predictor) -> Floats:
        return memory.rows["reward"]

    def _blend(self, memory: ReplayMemory, network: Predictor) -> Floats:
        return equalised(memory.rows["reward"], _values(memory, network), self._config.memory)

    def _protected(self, memory: ReplayMemory, network: Predictor) -> Floats:
        own = self._config.memory.model_copy(update={"protect_terminal": True})
        return equalised(memory.rows["reward"], _values(memory, network), own)

    def _anchored(self, memory: ReplayMemory, network: Predictor) -> Floats:
        own: MemoryConfig = self._config.memory
        return equalised(self._observed(memory), _values(memory, network), own)

    def _next_value(self, memory: ReplayMemory, network: Predictor) -> Floats:
        places = _places(memory)
        observed, then = self._observed(memory), self._then[places]
        known = ~np.isnan(then) & (observed > TERMINAL_REWARD)
        now = np.zeros(len(memory), np.float32)
        now[known] = self._values_of_next(places[known], network)
        weight = np.float32(self._config.reward.prediction_weight)
        return np.where(known, observed + weight * (now - np.nan_to_num(then)), observed)

    def _better_fits(self, memory: ReplayMemory, network: Predictor) -> Floats:
        better = self._fell.get(network.version, False)
        return self._blend(memory, network) if better else memory.rows["reward"]

    def _observed(self, memory: ReplayMemory) -> Floats:
        return self._stream.samples["reward"][_places(memory)]

    def _values_of_next(self, places: npt.NDArray[np.int64], network: Predictor) -> Floats:
        """Max Q of the images that follow; NaN where the next sample does not follow."""
        found = np.full(len(places), np.nan, np.float32)
        there = np.flatnonzero(self._follows(places))
        if len(there):
            images = np.array(self._stream.images[places[there] + 1])
            found[there] = network.all_values(images).max(axis=1)
        return found

    def _follows(self, places: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """Whether the next sample of the stream is what came of each sample."""
        samples = self._stream.samples
        following = np.minimum(places + 1, len(samples) - 1)
        here, there = samples[places], samples[following]
        way_m = np.hypot(there["x_m"] - here["x_m"], there["y_m"] - here["y_m"])
        alike = (here["world"] == there["world"]) & (here["reward"] > TERMINAL_REWARD)
        return np.asarray((following > places) & alike & (way_m < NEXT_M))


def _places(memory: ReplayMemory) -> npt.NDArray[np.int64]:
    """Places of the samples of a memory in its stream."""
    return memory.ids.astype(np.int64) - 1


def _values(memory: ReplayMemory, network: Predictor) -> Floats:
    """Q of each stored image and its action: float32 [n]."""
    parts = memory.parts(np.arange(len(memory)))
    return np.concatenate(
        [network.values(images, memory.rows["action"][some]) for some, images in parts]
    )


def _fell(losses: Mapping[int, float]) -> dict[int, bool]:
    """Whether the loss behind a version was lower than that behind the version before."""
    found, before = {}, float("-inf")
    for version, loss in sorted(losses.items()):
        found[version] = loss < before
        before = loss
    return found
