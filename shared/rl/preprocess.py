"""From a camera frame to the network's input image (A22, E29): resize, then grey, in that order.

The rounding is part of the definition, so that simulation, hardware drivers and tests agree to
the last bit: each step ends in uint8. Whatever changes one pixel must raise `PREPROCESS_VERSION`.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

PREPROCESS_VERSION = 1
"""Stored beside everything that was learned from these images."""

HEIGHT, WIDTH = 50, 75
"""Shape of the result; 16:9 frames are squeezed into it (E29)."""

_BT601 = np.array([4899, 9617, 1868], np.int32)
"""Luma weights 0.299, 0.587, 0.114 of BT.601 in units of 2**-14; they sum up to exactly 2**14."""


def preprocess(frame: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Area-resize an RGB frame to 50x75 and turn it grey (A22, E29).

    Args:
        frame: uint8 [h, w, 3], RGB, h and w at least 1; the usual camera gives [720, 1280, 3].

    Returns:
        uint8 [50, 75]: grey from 0 to 255, rounded half up. Divide by 255 for the network.

    Raises:
        ValueError: The frame has another shape or type.
    """
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3 or 0 in frame.shape:
        raise ValueError(f"expected a uint8 [h, w, 3] frame, got {frame.dtype} {frame.shape}")
    if frame.shape[:2] != (HEIGHT, WIDTH):
        frame = np.asarray(
            cv2.resize(frame, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA), np.uint8
        )
    luma = frame.astype(np.int32) @ _BT601
    return ((luma + (1 << 13)) >> 14).astype(np.uint8)
