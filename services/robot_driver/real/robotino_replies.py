"""What a Robotino answers, parsed without trust: sizes, types and ranges before use (no socket)."""

import math
from typing import Annotated, Any

from pydantic import BaseModel, Field, StrictBool, TypeAdapter, ValidationError

from services.robot_driver.real.link import Battery
from services.robot_driver.robot import Pose
from shared.errors import BadMessage, first_problem

MAX_JSON_BYTES = 16 * 1024
MAX_JPEG_BYTES = 4 * 1024 * 1024
MAX_M, MAX_RAD = 1e6, 1e4
"""A robot that counts farther than this counts nonsense."""
VOLTS = (5.0, 60.0)
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
"""Whole ones may come as integers, but true is no number."""
Metres = Annotated[Number, Field(ge=-MAX_M, le=MAX_M)]
Radians = Annotated[Number, Field(ge=-MAX_RAD, le=MAX_RAD)]


class Bumper(BaseModel):
    """Contact anywhere on the ring."""

    value: StrictBool


class Power(BaseModel):
    """The part of the power management's object that is used."""

    batteryLow: StrictBool  # noqa: N815
    voltage: Any = None


_ODOMETRY = TypeAdapter(tuple[Metres, Metres, Radians, Number, Number, Number, Number])


def odometry(body: bytes) -> tuple[Pose, float]:
    """Pose and sequence number of `[x, y, rot, vx, vy, omega, seq]`. Raises BadMessage."""
    x, y, heading, *_, sequence = _parsed(_ODOMETRY, body)
    return Pose(x, y, math.remainder(heading, 2.0 * math.pi)), sequence


def bumper(body: bytes) -> bool:
    """Whether the ring is pressed, of `{"value": bool}`. Raises BadMessage: no all-clear."""
    return bool(_parsed(TypeAdapter(Bumper), body).value)


def battery(body: bytes) -> Battery:
    """Charge, of the power management's object. Raises BadMessage."""
    power = _parsed(TypeAdapter(Power), body)
    volts = power.voltage if type(power.voltage) in (int, float) else math.nan
    return Battery(power.batteryLow, float(volts) if VOLTS[0] <= volts <= VOLTS[1] else None)


def _parsed(expected: TypeAdapter[Any], body: bytes) -> Any:
    if not body.strip():
        raise BadMessage("empty")
    try:
        return expected.validate_json(body)
    except ValidationError as error:
        raise BadMessage(f"not as expected: {first_problem(error)}") from error
