"""Which samples look like newer ones (A30): the search behind replay memory management."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from shared.rl.descriptor import BITS

Descriptors = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
ROWS = 512
"""Rows compared at a time: bounds the memory to a few dozen megabytes."""


def similar_to_newer(descriptors: Descriptors, bits: int, rule: Literal["paper", "cover"]) -> Mask:
    """Mark samples of one action that differ from a newer one in at most `bits` bits (E1).

    descriptors: uint8 [n, 15], oldest first. Rule "paper" compares with every newer sample,
    candidate or not; "cover" only with newer samples that are kept, so that everything dropped
    has a kept likeness (E23). Returns bool [n].
    """
    signs = _signs(descriptors)
    least_product = BITS - 2 * bits  # two descriptors at distance d have the product 120 - 2 d
    if rule == "paper":
        return _any_newer(signs, least_product)
    return _uncovered(signs, least_product)


def _signs(descriptors: Descriptors) -> Tensor:
    """Bits as -1 and 1, so that a matrix product counts agreements.

    Products are whole numbers up to 120: exact in bfloat16 too, which is used where the processor
    multiplies it faster.
    """
    signs = np.unpackbits(descriptors, axis=1).astype(np.float32) * 2.0 - 1.0
    fast = torch.ops.mkldnn._is_mkldnn_bf16_supported()
    return torch.from_numpy(signs).to(torch.bfloat16 if fast else torch.float32)


def _any_newer(signs: Tensor, least_product: int) -> Mask:
    """Compare blocks of rows with ever newer rows; rows already marked drop out of the search."""
    n = len(signs)
    marked = np.zeros(n, np.bool_)
    for start in range(0, n, ROWS):
        stop = min(start + ROWS, n)
        own = signs[start:stop] @ signs[start:stop].T >= least_product
        marked[start:stop] = own.triu(diagonal=1).any(dim=1).numpy()
        for newer in range(stop, n, 8 * ROWS):
            open_rows = start + np.flatnonzero(~marked[start:stop])
            if not len(open_rows):
                break
            rows = signs[torch.from_numpy(open_rows)]
            products = rows @ signs[newer : newer + 8 * ROWS].T
            marked[open_rows] = (products.amax(dim=1) >= least_product).numpy()
    return marked


def _uncovered(signs: Tensor, least_product: int) -> Mask:
    """From the newest to the oldest, keep a sample only if no kept newer one is similar."""
    n = len(signs)
    kept = np.zeros(n, np.bool_)
    for stop in range(n, 0, -ROWS):
        start = max(stop - ROWS, 0)
        block = signs[start:stop]
        newer = signs[stop + torch.from_numpy(np.flatnonzero(kept[stop:]))]
        covered = np.zeros(len(block), np.bool_)
        if len(newer):
            covered |= ((block @ newer.T).amax(dim=1) >= least_product).numpy()
        own = (block @ block.T >= least_product).numpy()
        for row in range(len(block) - 1, -1, -1):
            inside = own[row, row + 1 :] & kept[start + row + 1 : stop]
            kept[start + row] = not (covered[row] or inside.any())
    return ~kept
