"""Compressed pictures from cameras that nobody vouches for: sizes before pixels."""

from __future__ import annotations

import io
import zlib

import numpy as np
import numpy.typing as npt
from PIL import Image

from shared.errors import BadMessage

RgbImage = npt.NDArray[np.uint8]
MAX_SIDE_PX = 4096
_JPEG, _JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"IEND\xae\x42\x60\x82"
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of JPEG that tell the picture's size."""
_SCAN = 0xDA


def decoded(data: bytes) -> RgbImage:
    """A whole JPEG or PNG as uint8 [h, w, 3], RGB.

    Raises:
        BadMessage: It is neither, breaks off (decoders would fill the rest with grey), or is larger
            than `MAX_SIDE_PX` either way.
    """
    if data.startswith(_JPEG):
        size, whole = _jpeg_size(data), data.rstrip(b"\0").endswith(_JPEG_END)
    elif data.startswith(_PNG):
        size, whole = _png_size(data), data.rstrip(b"\0").endswith(_PNG_END)
    else:
        raise BadMessage("neither JPEG nor PNG")
    if not whole:
        raise BadMessage("picture breaks off")
    if size is None or not all(0 < side <= MAX_SIDE_PX for side in size):
        raise BadMessage("picture of unusable size")
    try:
        with Image.open(io.BytesIO(data), formats=["JPEG", "PNG"]) as picture:
            if picture.mode.startswith(("I", "F")):
                raise BadMessage(f"picture is not of 8 bits: {picture.mode}")
            return np.asarray(picture.convert("RGB"), np.uint8)
    except (OSError, SyntaxError, ValueError, zlib.error) as error:  # as Pillow says it is broken
        raise BadMessage("picture cannot be decoded") from error


def _png_size(data: bytes) -> tuple[int, int] | None:
    """Width and height told by the first chunk."""
    if len(data) < 24 or data[12:16] != b"IHDR":
        return None
    return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Width and height told by the frame's segment, which comes before the pixels."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if marker == 0xFF:  # a fill byte
            at += 1
        elif marker in _FRAMES:
            height, width = data[at + 5 : at + 7], data[at + 7 : at + 9]
            return int.from_bytes(width, "big"), int.from_bytes(height, "big")
        elif marker == _SCAN or length < 2:
            return None
        else:
            at += 2 + length
    return None
