"""Which samples look like newer ones (A30): the search behind replay memory management."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt

from shared.rl.descriptor import BITS

if TYPE_CHECKING:
    from torch import Tensor

Descriptors = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
ROWS = 512
"""Rows compared at a time."""
NEWER = 8 * ROWS
"""Newer rows that rows are compared with at a time. Fewer are taken `ROWS` at a time."""
STEP = 128
"""Open rows are filled up to a multiple of it."""


def similar_to_newer(descriptors: Descriptors, bits: int, rule: Literal["paper", "cover"]) -> Mask:
    """Mark samples of one action that differ from a newer one in at most `bits` bits (E1).

    descriptors: uint8 [n, 15], oldest first. Rule "paper" compares with every newer sample,
    candidate or not; "cover" only with newer samples that are kept, so that everything dropped
    has a kept likeness (E23). Returns bool [n].
    """
    n = len(descriptors)
    if not n:
        return np.zeros(0, np.bool_)
    # The library keeps half a megabyte for each shape of a product it has met: few shapes, by
    # filling up to whole blocks. In front, so that nothing is compared with what fills up.
    filled = -n % ROWS
    signs = _signs(np.concatenate([descriptors[-1:].repeat(filled, axis=0), descriptors]))
    least_product = BITS - 2 * bits  # two descriptors at distance d have the product 120 - 2 d
    search = _any_newer if rule == "paper" else _uncovered
    return search(signs, least_product)[filled:]


def _signs(descriptors: Descriptors) -> Tensor:
    """Bits as -1 and 1. Products are whole numbers up to 120: exact in bfloat16 too."""
    import torch

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
        for newer in _pieces(stop, n):
            open_rows = start + np.flatnonzero(~marked[start:stop])
            if not len(open_rows):
                break
            size = -(-len(open_rows) // STEP) * STEP
            padded = np.resize(open_rows, size)  # over again from the first
            nearest = _largest_products(signs[padded], signs[newer])
            marked[open_rows] = (nearest >= least_product)[: len(open_rows)]
    return marked


def _pieces(start: int, end: int) -> Iterator[slice]:
    """All from `start` to `end`: large pieces while they last, then small ones."""
    while start < end:
        stop = start + (NEWER if end - start >= NEWER else ROWS)
        yield slice(start, min(stop, end))
        start = stop


def _largest_products(rows: Tensor, others: Tensor) -> npt.NDArray[np.int16]:
    """The largest product of each row with any of the others."""
    return (rows @ others.T).amax(dim=1).short().numpy()


def _uncovered(signs: Tensor, least_product: int) -> Mask:
    """From the newest to the oldest, keep a sample only if no kept newer one is similar."""
    n = len(signs)
    kept = np.zeros(n, np.bool_)
    # Filled up with the newest sample, which is always kept: comparing with it again is harmless.
    kept_signs, count = signs[-1:].repeat(n + ROWS, 1), 0
    for stop in range(n, 0, -ROWS):
        start = max(stop - ROWS, 0)
        block = signs[start:stop]
        covered = np.zeros(len(block), np.bool_)
        for newer in _pieces(0, -(-count // ROWS) * ROWS):
            covered |= _largest_products(block, kept_signs[newer]) >= least_product
        own = (block @ block.T >= least_product).numpy()
        for row in range(len(block) - 1, -1, -1):
            inside = own[row, row + 1 :] & kept[start + row + 1 : stop]
            kept[start + row] = not (covered[row] or inside.any())
        fresh = block[kept[start:stop]]
        kept_signs[count : count + len(fresh)] = fresh
        count += len(fresh)
    return ~kept
