"""What a Robotino answers, parsed without trust: sizes, types and ranges before use (no socket)."""

from __future__ import annotations

import io
import json
import math
from typing import Any

import numpy as np
from PIL import Image

from services.robot_driver.real.link import Battery
from services.robot_driver.robot import Pose
from shared.facts import IMAGE_HEIGHT, IMAGE_WIDTH
from shared.messages import ImageArray
from shared.rl.preprocess import preprocess

MAX_JSON_BYTES = 16 * 1024
MAX_JPEG_BYTES = 4 * 1024 * 1024
MAX_SIDE_PX = 4096
MAX_M, MAX_RAD = 1e6, 1e4
"""A robot that counts farther than this counts nonsense."""
VOLTS = (5.0, 60.0)
_START, _END = b"\xff\xd8", b"\xff\xd9"
_TAIL = 64
"""Bytes in which a whole picture has its end marker; some cameras leave padding behind it."""
_WITHOUT_LENGTH = {0x01, *range(0xD0, 0xD9)}
_SIZES = {0xC0, 0xC1, 0xC2}
"""Baseline, extended and progressive frames: they tell height and width."""


class BadReply(Exception):
    """An answer that cannot be used; the text, of a fixed vocabulary, says why."""


def odometry(body: bytes) -> tuple[Pose, int]:
    """Pose and sequence number of `[x, y, rot, vx, vy, omega, seq]`. Raises BadReply."""
    values = _json(body)
    if not isinstance(values, list) or len(values) != 7:
        raise BadReply("expected 7 numbers")
    x, y, heading = [_number(value) for value in values[:6]][:3]
    sequence = values[6]
    if isinstance(sequence, float) and sequence.is_integer():
        sequence = int(sequence)
    if isinstance(sequence, bool) or not isinstance(sequence, int):
        raise BadReply("expected a whole sequence number")
    if max(abs(x), abs(y)) > MAX_M or abs(heading) > MAX_RAD:
        raise BadReply("out of range")
    return Pose(x, y, math.remainder(heading, 2.0 * math.pi)), sequence


def bumper(body: bytes) -> bool:
    """Whether the ring is pressed, of `{"value": bool}`. Raises BadReply: that is no all-clear."""
    tree = _json(body)
    value = tree.get("value") if isinstance(tree, dict) else None
    if not isinstance(value, bool):
        raise BadReply("expected true or false")
    return value


def battery(body: bytes) -> Battery:
    """Charge, of the power management's object. Raises BadReply."""
    tree = _json(body)
    low = tree.get("batteryLow") if isinstance(tree, dict) else None
    if not isinstance(low, bool):
        raise BadReply("expected batteryLow")
    voltage = tree.get("voltage")
    plain = isinstance(voltage, (int, float)) and not isinstance(voltage, bool)
    sane = plain and VOLTS[0] <= voltage <= VOLTS[1]
    return Battery(low, float(voltage) if sane else None)


def camera(body: bytes) -> ImageArray:
    """The network's picture, uint8 [50, 75], of a whole JPEG (A22). Raises BadReply.

    A picture that breaks off is refused: decoders fill the rest with grey.
    """
    width, height = jpeg_size(body)
    if _END not in body[-_TAIL:]:  # it cannot stand inside the compressed picture
        raise BadReply("truncated")
    try:
        with Image.open(io.BytesIO(body), formats=["JPEG"]) as picture:
            if (
                width >= 4 * IMAGE_WIDTH and height >= 4 * IMAGE_HEIGHT
            ):  # decoding half as large is quicker
                picture.draft("RGB", (width // 2, height // 2))
            return preprocess(np.asarray(picture.convert("RGB"), np.uint8))
    except (OSError, SyntaxError, ValueError) as error:  # what Pillow says of broken files
        raise BadReply("not a JPEG") from error


def jpeg_size(body: bytes) -> tuple[int, int]:
    """Width and height as a JPEG's header tells, before anything is decoded. Raises BadReply."""
    if not body:
        raise BadReply("empty")
    if body[:2] != _START:
        raise BadReply("not a JPEG")
    at = 2
    while at + 9 <= len(body) and body[at] == 0xFF:
        marker = body[at + 1]
        if marker == 0xFF:
            at += 1
            continue
        if marker in _WITHOUT_LENGTH:
            at += 2
            continue
        if marker in _SIZES:
            height = int.from_bytes(body[at + 5 : at + 7], "big")
            width = int.from_bytes(body[at + 7 : at + 9], "big")
            if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
                raise BadReply("unusable size")
            return width, height
        if marker == 0xDA:
            break
        at += 2 + int.from_bytes(body[at + 2 : at + 4], "big")
    raise BadReply("truncated" if at + 9 > len(body) else "not a JPEG")


def _json(body: bytes) -> Any:
    if not body.strip():
        raise BadReply("empty")
    try:
        return json.loads(body)
    except (ValueError, RecursionError) as error:
        raise BadReply("not JSON") from error


def _number(value: object) -> float:
    """A finite number; whole ones may come as integers, but true is no number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise BadReply("expected numbers")
    try:
        number = float(value)
    except OverflowError as error:
        raise BadReply("out of range") from error
    if not math.isfinite(number):
        raise BadReply("expected finite numbers")
    return number
