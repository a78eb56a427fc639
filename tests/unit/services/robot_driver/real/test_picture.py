"""Compressed pictures: told sizes are believed before pixels are made, broken ones refused."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageOps

from services.robot_driver.real.picture import MAX_SIDE_PX, decoded
from shared.errors import BadMessage
from shared.rl.preprocess import preprocess

FAST = settings(deadline=None, max_examples=60, derandomize=True)

DATA = Path(__file__).parent / "pictures"
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


def test_a_picture_with_a_hole_in_it_is_refused_wherever_the_hole_is() -> None:
    """As a lost packet leaves it: other decoders go on with what follows, and say nothing."""
    large = np.random.default_rng(1).normal(np.kron(RGB[:15, :20], np.ones((16, 16, 1))), 5)
    for form in (".jpg", ".png"):
        whole = cv2.imencode(form, np.clip(large, 0, 255).astype(np.uint8))[1].tobytes()
        for start in range(700, len(whole) - 1500, len(whole) // 20):
            with pytest.raises(BadMessage):
                decoded(whole[:start] + whole[start + 1400 :])


@pytest.mark.parametrize(
    ("name", "whole"), [("junk-after-end", True), ("lost-middle", False), ("lost-end", False)]
)
def test_pictures_of_real_cameras(name: str, whole: bool) -> None:
    data = (DATA / f"{name}.jpg").read_bytes()
    if whole:
        assert decoded(data).shape == (225, 300, 3)
        assert np.array_equal(decoded(data), decoded(data + b"junk\xff\xd8\xff"))
        return
    with pytest.raises(BadMessage, match="damaged or cut off"):
        decoded(data)


@pytest.mark.parametrize("mode", ["L", "RGB", "CMYK"])
@pytest.mark.parametrize("progressive", [False, True])
def test_grey_colour_and_print_colours_come_out_alike(mode: str, progressive: bool) -> None:
    smooth = np.dstack([np.linspace(0, 255, 48 * 64).reshape(48, 64)] * 3).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(smooth).convert(mode).save(file, "JPEG", quality=95, progressive=progressive)
    assert np.abs(decoded(file.getvalue()).astype(int) - smooth).max() < 12
    with pytest.raises(BadMessage):
        decoded(file.getvalue()[:-300])


@pytest.mark.parametrize("held", range(1, 9))
def test_a_camera_that_was_held_otherwise_shows_the_same(held: int) -> None:
    exif, file = Image.Exif(), io.BytesIO()
    exif[0x0112] = held
    Image.fromarray(RGB).save(file, "JPEG", quality=95, exif=exif)
    with Image.open(file) as picture:
        upright = np.asarray(ImageOps.exif_transpose(picture))
    assert decoded(file.getvalue()).shape == upright.shape
    assert np.abs(decoded(file.getvalue()).astype(int) - upright).mean() < 1


def test_a_large_picture_is_made_smaller_as_it_is_decoded() -> None:
    large = np.ascontiguousarray(np.kron(RGB, np.ones((12, 12, 1), np.uint8)))
    data = cv2.imencode(".jpg", large[:, :, ::-1])[1].tobytes()
    picture = decoded(data)
    assert picture.shape[0] <= large.shape[0] / 2
    assert np.abs(preprocess(picture).astype(int) - preprocess(large)).max() <= 6


@FAST
@given(st.binary(max_size=80), st.sampled_from([b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b""]))
def test_noise_is_refused(noise: bytes, head: bytes) -> None:
    with pytest.raises(BadMessage):
        decoded(head + noise)
