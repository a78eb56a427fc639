"""Makes the network's image of a camera frame (A22, E29): resize first, then grey.

The rounding is part of the definition, to the last bit on any processor: exact means over areas,
and each step ends in uint8, rounded half up. Whatever changes one pixel must raise
`PREPROCESS_VERSION`.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from shared.facts import IMAGE_HEIGHT, IMAGE_SHAPE, IMAGE_WIDTH

PREPROCESS_VERSION = 2
"""2: exact means. 1 left their last bit to OpenCV."""

_BT601 = np.array([4899, 9617, 1868], np.int32)
"""Luma weights 0.299, 0.587, 0.114 of BT.601 in units of 2**-14; they sum up to exactly 2**14."""


def preprocess(frame: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Area-resize an RGB frame uint8 [h, w, 3] and turn it grey (A22, E29): uint8 [50, 75].

    Divide by 255 for the network. Raises ValueError for a frame of another shape or type.
    """
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3 or 0 in frame.shape:
        raise ValueError(f"expected a uint8 [h, w, 3] frame, got {frame.dtype} {frame.shape}")
    if frame.shape[:2] != IMAGE_SHAPE:
        frame = _resized(frame)
    luma = frame.astype(np.int32) @ _BT601
    return ((luma + (1 << 13)) >> 14).astype(np.uint8)


def _resized(frame: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """uint8 [50, 75, 3]: the means over the areas that pixels of the result cover in the frame."""
    height, width = frame.shape[:2]
    rows = _area_sums(frame, IMAGE_HEIGHT, np.int32)
    sums = _area_sums(rows.swapaxes(0, 1), IMAGE_WIDTH, np.int64).swapaxes(0, 1)
    area = height * width
    return np.asarray((2 * sums + area) // (2 * area), np.uint8)


def _area_sums(
    values: npt.NDArray[Any], cells: int, dtype: type[np.integer[Any]]
) -> npt.NDArray[Any]:
    """Weighted sums along the first axis over `cells` equal cells; weights add up to its length."""
    border, part = np.divmod(np.arange(cells + 1) * len(values), cells)
    start, end = border[:-1], border[1:]
    shape = (cells,) + (1,) * (values.ndim - 1)
    # Of values that begin within the cell: all, less what the first gave to the cell before, plus
    # what the next cell's first gives to this one.
    whole = np.add.reduceat(values, start, axis=0, dtype=dtype)
    whole[start == end] = 0  # cells smaller than a value: reduceat takes the one it points to
    before = values[start] * part[:-1].astype(dtype).reshape(shape)
    after = values[np.minimum(end, len(values) - 1)] * part[1:].astype(dtype).reshape(shape)
    return np.asarray(whole * dtype(cells) - before + after, dtype)
