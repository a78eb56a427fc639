"""Pictures from cameras that nobody vouches for: sizes before pixels, and damage is refused.

One rule for all robots: a picture is whole up to its own end marker, and what follows is ignored.
"""

import io
import struct
import zlib

import numpy as np
import numpy.typing as npt
import simplejpeg
from PIL import Image

from shared.errors import BadMessage
from shared.facts import IMAGE_HEIGHT, IMAGE_WIDTH

RgbImage = npt.NDArray[np.uint8]
MAX_SIDE_PX = 4096
ENCODINGS: dict[str, tuple[int, tuple[int, ...]]] = {
    **dict.fromkeys(("mono8", "8UC1", "nv12"), (1, (0,))),
    **dict.fromkeys(("mono16", "yuv422", "uyvy"), (2, (1,))),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, (0,))),
    **{"rgb8": (3, (0, 1, 2)), "bgr8": (3, (2, 1, 0)), "8UC3": (3, (2, 1, 0))},
    **{"rgba8": (4, (0, 1, 2)), "bgra8": (4, (2, 1, 0))},
}
"""Raw pictures by the name of their encoding: bytes of a pixel, and which of them are red, green
and blue, or grey alone. Of YUV the brightness is enough, because the network sees grey."""
_JPEG, _PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
_ORIENTATION = 0x0112
"""EXIF's tag of how the camera was held."""


def decoded(data: bytes) -> RgbImage:
    """A whole JPEG or PNG as uint8 [h, w, 3], RGB, upright, maybe smaller than it was.

    Raises BadMessage: it is neither, larger than `MAX_SIDE_PX` either way, or damaged, where other
    decoders would fill in what is missing.
    """
    if not data.startswith((_JPEG, _PNG)):
        raise BadMessage("neither JPEG nor PNG")
    try:
        return _jpeg(data) if data.startswith(_JPEG) else _png(data)
    except (
        OSError,
        SyntaxError,
        ValueError,
        struct.error,
        zlib.error,
    ) as error:  # as the decoders say it
        raise BadMessage("damaged or cut off") from error


def raw(
    encoding: str, size_px: tuple[int, int], step: int, big_endian: bool, data: RgbImage
) -> RgbImage:
    """The pixels of an uncompressed picture, flat uint8 data, as uint8 [h, w, 3], RGB.

    step: bytes of a row, padding included. big_endian: order of the bytes of mono16. Raises
    BadMessage for an encoding that is none of `ENCODINGS`, or sizes that do not fit.
    """
    if encoding not in ENCODINGS:
        raise BadMessage(f"unknown encoding: {encoding!r:.24}, accepted: {', '.join(ENCODINGS)}")
    (width, height), (pixel, order) = size_px, ENCODINGS[encoding]
    _check_size(width, height)
    rows = height * 3 // 2 if encoding == "nv12" else height
    if step < width * pixel or len(data) != step * rows:
        raise BadMessage(
            f"rows do not fit: {width}x{height} {encoding}, step {step}, {len(data)} bytes"
        )
    pixels = data.reshape(rows, step)[:height, : width * pixel].reshape(height, width, pixel)
    if encoding == "mono16" and big_endian:
        order = (0,)
    return np.ascontiguousarray(pixels[:, :, order * (3 // len(order))])


def _check_size(width: int, height: int) -> None:
    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
        raise BadMessage(f"picture of unusable size: {width}x{height}")


def _jpeg(data: bytes) -> RgbImage:
    height, width, colours, _ = simplejpeg.decode_jpeg_header(data)
    _check_size(width, height)
    least = {"min_height": 4 * IMAGE_HEIGHT, "min_width": 4 * IMAGE_WIDTH}  # smaller is quicker
    if colours in ("CMYK", "YCCK"):
        simplejpeg.decode_jpeg(data, "CMYK", strict=True)
        with Image.open(io.BytesIO(data), formats=["JPEG"]) as picture:
            pixels = np.asarray(picture.convert("RGB"), np.uint8)
    else:
        pixels = simplejpeg.decode_jpeg(data, "RGB", strict=True, **least)
    return _upright(pixels, data) if b"Exif\0\0" in data[:4096] else pixels


def _upright(pixels: RgbImage, data: bytes) -> RgbImage:
    """Turn and mirror as EXIF tells."""
    with Image.open(io.BytesIO(data), formats=["JPEG"]) as picture:
        held = picture.getexif().get(_ORIENTATION, 1)
    if held in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    if held in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if held in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels)


def _png(data: bytes) -> RgbImage:
    if data[12:16] != b"IHDR":
        raise BadMessage("damaged or cut off")
    _check_size(int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big"))
    with Image.open(io.BytesIO(data), formats=["PNG"]) as picture:
        picture.verify()  # the checksums of all parts, up to its end
    with Image.open(io.BytesIO(data), formats=["PNG"]) as picture:
        if picture.mode.startswith(("I", "F")):
            raise BadMessage(f"picture is not of 8 bits: {picture.mode}")
        return np.asarray(picture.convert("RGB"), np.uint8)
