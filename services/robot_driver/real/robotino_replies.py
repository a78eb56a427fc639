"""What a Robotino answers, parsed without trust: sizes, types and ranges before use (no socket)."""

from __future__ import annotations

import json
import math
from typing import Any

from services.robot_driver.real.link import Battery
from services.robot_driver.robot import Pose
from shared.errors import BadMessage

MAX_JSON_BYTES = 16 * 1024
MAX_JPEG_BYTES = 4 * 1024 * 1024
MAX_M, MAX_RAD = 1e6, 1e4
"""A robot that counts farther than this counts nonsense."""
VOLTS = (5.0, 60.0)


def odometry(body: bytes) -> tuple[Pose, int]:
    """Pose and sequence number of `[x, y, rot, vx, vy, omega, seq]`. Raises BadMessage."""
    values = _json(body)
    if not isinstance(values, list) or len(values) != 7:
        raise BadMessage("expected 7 numbers")
    x, y, heading = [_number(value) for value in values[:6]][:3]
    sequence = values[6]
    if isinstance(sequence, float) and sequence.is_integer():
        sequence = int(sequence)
    if isinstance(sequence, bool) or not isinstance(sequence, int):
        raise BadMessage("expected a whole sequence number")
    if max(abs(x), abs(y)) > MAX_M or abs(heading) > MAX_RAD:
        raise BadMessage("out of range")
    return Pose(x, y, math.remainder(heading, 2.0 * math.pi)), sequence


def bumper(body: bytes) -> bool:
    """Whether the ring is pressed, of `{"value": bool}`. Raises BadMessage: no all-clear."""
    tree = _json(body)
    value = tree.get("value") if isinstance(tree, dict) else None
    if not isinstance(value, bool):
        raise BadMessage("expected true or false")
    return value


def battery(body: bytes) -> Battery:
    """Charge, of the power management's object. Raises BadMessage."""
    tree = _json(body)
    low = tree.get("batteryLow") if isinstance(tree, dict) else None
    if not isinstance(low, bool):
        raise BadMessage("expected batteryLow")
    voltage = tree.get("voltage")
    plain = isinstance(voltage, (int, float)) and not isinstance(voltage, bool)
    sane = plain and VOLTS[0] <= voltage <= VOLTS[1]
    return Battery(low, float(voltage) if sane else None)


def _json(body: bytes) -> Any:
    if not body.strip():
        raise BadMessage("empty")
    try:
        return json.loads(body)
    except (ValueError, RecursionError) as error:
        raise BadMessage("not JSON") from error


def _number(value: object) -> float:
    """A finite number; whole ones may come as integers, but true is no number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise BadMessage("expected numbers")
    try:
        number = float(value)
    except OverflowError as error:
        raise BadMessage("out of range") from error
    if not math.isfinite(number):
        raise BadMessage("expected finite numbers")
    return number
