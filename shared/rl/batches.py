"""Mini-batches as tensors: gathered from the store, or from a copy of it on the GPU."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from shared.facts import MIRRORED
from shared.rl.memory import SampleStore

Ranks = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]


class Batch(NamedTuple):
    """k samples: images uint8 [k, 50, 75], actions int64 [k], rewards float32 [k]."""

    images: Tensor
    actions: Tensor
    rewards: Tensor

    def mirrored(self, which: Tensor) -> "Batch":
        """The batch with some samples, bool [k], seen in a mirror: left is right, rewards stay."""
        images = torch.where(which[:, None, None], self.images.flip(-1), self.images)
        sides = torch.tensor(MIRRORED, device=self.actions.device)
        actions = torch.where(which, sides[self.actions], self.actions)
        return Batch(images, actions, self.rewards)


class Batches:
    """Mini-batches gathered from the store, copied to the device that trains."""

    def __init__(self, samples: SampleStore, device: str) -> None:
        self._samples, self._device = samples, device

    def take(self, ranks: Ranks) -> Batch:
        """Copies of the samples at these ranks."""
        rows = self._samples.rows
        return Batch(
            torch.from_numpy(self._samples.images(ranks)).to(self._device),
            torch.from_numpy(rows["action"][ranks].astype(np.int64)).to(self._device),
            torch.from_numpy(rows["reward"][ranks].astype(np.float32)).to(self._device),
        )


class ResidentBatches(Batches):
    """All samples on the device, images as uint8, so that gathering never waits for the host."""

    def __init__(self, samples: SampleStore, device: str) -> None:
        super().__init__(samples, device)
        self._all = super().take(np.arange(len(samples), dtype=np.int64))

    def take(self, ranks: Ranks) -> Batch:
        """Copies of the samples at these ranks, made on the device."""
        places = torch.from_numpy(ranks).to(self._device, non_blocking=True)
        return Batch(*(column[places] for column in self._all))
