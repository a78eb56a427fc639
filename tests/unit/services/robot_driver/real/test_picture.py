"""Compressed pictures: told sizes are believed before pixels are made, broken ones refused."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.robot_driver.real.picture import MAX_SIDE_PX, decoded
from shared.errors import BadMessage

FAST = settings(deadline=None, max_examples=60, derandomize=True)

RGB = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)


def encoded(form: str) -> bytes:
    return bytes(cv2.imencode(form, np.ascontiguousarray(RGB[:, :, ::-1]))[1].tobytes())


def test_png_comes_back_bit_for_bit_in_rgb() -> None:
    assert np.array_equal(decoded(encoded(".png")), RGB)


@pytest.mark.parametrize("form", [".png", ".jpg"])
def test_padding_behind_the_picture_does_not_matter(form: str) -> None:
    assert np.array_equal(decoded(encoded(form) + bytes(3)), decoded(encoded(form)))


@pytest.mark.parametrize("form", [".png", ".jpg"])
def test_no_shorter_picture_passes(form: str) -> None:
    whole = encoded(form)
    for length in range(0, len(whole) - 1, 7):
        with pytest.raises(BadMessage):
            decoded(whole[:length])


def test_grey_pictures_become_grey_rgb() -> None:
    data = cv2.imencode(".png", RGB[:, :, 0])[1].tobytes()
    assert np.array_equal(decoded(data), np.repeat(RGB[:, :, :1], 3, axis=2))


def test_pictures_larger_than_any_camera_are_refused_before_they_are_made() -> None:
    side = MAX_SIDE_PX + 1
    head = struct.pack(">II5B", side, side, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", 13) + b"IHDR" + head + struct.pack(">I", zlib.crc32(b"IHDR" + head))
    png = b"\x89PNG\r\n\x1a\n" + chunk + b"\0\0\0\0IEND\xae\x42\x60\x82"
    with pytest.raises(BadMessage, match="unusable size"):
        decoded(png)
    jpeg = bytearray(encoded(".jpg"))
    at = jpeg.index(b"\xff\xc0")
    jpeg[at + 5 : at + 9] = struct.pack(">HH", 65000, 65000)
    with pytest.raises(BadMessage, match="unusable size"):
        decoded(bytes(jpeg))


@FAST
@given(st.binary(max_size=80), st.sampled_from([b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b""]))
def test_noise_is_refused(noise: bytes, head: bytes) -> None:
    with pytest.raises(BadMessage):
        decoded(head + noise)
