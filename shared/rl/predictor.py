"""Inference with fixed arithmetic: what a role predicts does not depend on who else asks.

Images are processed in passes of exactly `numerics.batch`, the last one padded, so that the value
of an image at one place of a pass is the same bits whoever shares the pass; threads, precision and
batch are configuration (docs/architecture.md).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from shared.rl.descriptor import block_sums, describe
from shared.rl.network import (
    IMAGE_HEIGHT,
    IMAGE_WIDTH,
    QNetwork,
    channels_last,
    load_bytes,
    weights_hash,
)

if TYPE_CHECKING:
    from shared.config import NetworkConfig, Numerics

Images = npt.NDArray[np.uint8]
Progress = Callable[[int, int], None]
"""Called with (images done, images in all)."""


@contextmanager
def arithmetic(numerics: Numerics) -> Iterator[None]:
    """Apply a role's thread count to the calling thread. Raises ValueError for unsettled ones."""
    if not numerics.settled:
        raise ValueError(f"numerics must be settled before use, got {numerics}")
    if torch.get_num_threads() != numerics.threads:
        torch.set_num_threads(numerics.threads)
    yield


def network_input(images: Images, device: str) -> Tensor:
    """uint8 [n, 50, 75] to float32 [n, 1, 50, 75] in [0, 1] (A22)."""
    tensor = torch.from_numpy(np.array(images)).to(device)  # received images are read-only
    # One channel is laid out both ways at once; made last by its strides, the convolutions take it
    # as it is instead of copying everything after the first of them.
    channels_last = tensor.unsqueeze(-1).permute(0, 3, 1, 2)
    return channels_last.to(torch.float32).div_(255.0)


def feature_maps(network: QNetwork, images: Tensor, numerics: Numerics) -> Tensor:
    """MaxPool2 maps in float32, the convolutions in the role's precision."""
    if numerics.precision == "float32":
        return network.maps(images)
    with torch.autocast(numerics.device, torch.bfloat16):
        return network.maps(images).to(torch.float32)


class Predictor:
    """One version of the target network, ready to predict."""

    def __init__(self, network: NetworkConfig, numerics: Numerics) -> None:
        self.version = 0
        self.hash = ""
        self._numerics = numerics
        self._network = channels_last(QNetwork(network)).to(numerics.device)
        self._network.eval().requires_grad_(False)

    def load(self, version: int, data: bytes) -> None:
        """Become `version`, given as safetensors bytes. Raises ValueError if they do not fit."""
        load_bytes(self._network, data)
        self.version, self.hash = version, weights_hash(data)

    def all_values(
        self, images: Images, progress: Progress | None = None
    ) -> npt.NDArray[np.float32]:
        """Q(s, a) of all actions, clipped to [-1, 1] (A24, E8): float32 [n, 3]."""
        return self._passes(
            images, lambda maps: self._network.all_values(maps).clamp(-1.0, 1.0), progress
        )

    def values(
        self, images: Images, actions: npt.NDArray[np.uint8], progress: Progress | None = None
    ) -> npt.NDArray[np.float32]:
        """Q(s, a) of the given action of each image, clipped: float32 [n]."""
        every = self.all_values(images, progress)
        return every[np.arange(len(images)), actions]

    def descriptors(
        self, images: Images, progress: Progress | None = None
    ) -> npt.NDArray[np.uint8]:
        """Packed 120-bit descriptors uint8 [n, 15] (A29)."""
        return describe(self._passes(images, block_sums, progress))

    def _passes(
        self, images: Images, head: Callable[[Tensor], Tensor], progress: Progress | None
    ) -> npt.NDArray[np.float32]:
        n, size = len(images), self._numerics.batch
        outputs = []
        with arithmetic(self._numerics), torch.inference_mode():
            for start in range(0, n, size):
                part = images[start : start + size]
                padded = part
                if len(part) < size:
                    padded = np.zeros((size, IMAGE_HEIGHT, IMAGE_WIDTH), np.uint8)
                    padded[: len(part)] = part
                tensor = network_input(padded, self._numerics.device)
                maps = feature_maps(self._network, tensor, self._numerics)
                outputs.append(head(maps)[: len(part)].cpu().numpy())
                if progress is not None:
                    progress(start + len(part), n)
        return np.concatenate(outputs) if outputs else np.zeros((0, 3), np.float32)
