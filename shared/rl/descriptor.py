"""Binary descriptors of images from the network's own features (section 3.5.1, Fig 3.7)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

BLOCKS = 16
BITS = BLOCKS * (BLOCKS - 1) // 2
"""120 pair comparisons (A29, E17)."""
BYTES = BITS // 8
_FIRST, _SECOND = np.triu_indices(BLOCKS, k=1)  # (0,1), (0,2) ... (14,15): lexicographic


def block_sums(maps: Tensor) -> Tensor:
    """Sums over 16 blocks of the MaxPool2 maps: [n, filters, 9, 15] to [n, 16].

    A block is filters / 16 consecutive channels, summed over all positions (E17): 4 of 64. Networks
    with fewer than 16 filters cut each channel into 16 / filters vertical stripes instead.
    """
    n, filters = maps.shape[:2]
    if filters % BLOCKS == 0:
        return maps.reshape(n, BLOCKS, -1).sum(dim=2)
    if BLOCKS % filters:
        raise ValueError(f"filters must divide {BLOCKS} or be a multiple of it, got {filters}")
    stripes = torch.tensor_split(maps, BLOCKS // filters, dim=3)
    return torch.stack([stripe.sum(dim=(2, 3)) for stripe in stripes], dim=2).reshape(n, BLOCKS)


def describe(sums: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """Descriptors of block sums [n, 16]: bit (i, j), i < j, is sum_i > sum_j; ties give 0 (E17).

    Returns uint8 [n, 15], the 120 bits packed most significant first.
    """
    sums = sums.reshape(-1, BLOCKS)
    return np.packbits(sums[:, _FIRST] > sums[:, _SECOND], axis=1)


def threshold_bits(percent: int) -> int:
    """A similarity threshold in percent of 120 bits as whole bits: floor(1.2 p) (E18)."""
    return BITS * percent // 100
