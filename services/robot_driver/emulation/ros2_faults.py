"""Faults that an emulated ROS 2 robot can have, changed while it runs."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from services.robot_driver.emulation.dynamics import CREATE3
from shared.codec import first_problem


class Ros2Faults(BaseModel):
    """What is wrong with the robot or with the way to it. Frozen; the defaults are a sound one."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    nobody_listens: bool = False
    """No node of the base takes velocities."""
    wrong_type: bool = False
    """The base listens for the other type of velocity."""
    odometry: Literal["", "frozen", "silent", "stalled"] = ""
    """frozen: the same message again and again; stalled: the motors do not turn, readings go on."""
    camera: Literal["", "frozen", "restamped", "silent"] = ""
    """frozen: the same message again and again; restamped: the same picture with new stamps."""
    bumper: Literal["", "stuck", "silent"] = ""
    """stuck: pressed; silent: nobody publishes it."""
    payload: Literal["", "truncated", "big-endian", "padded"] = ""
    """What happens to the bytes of messages; big-endian and padded ones are still good."""
    payload_of: Literal["all", "odometry", "camera", "bumper"] = "all"
    duplicates: bool = False
    """Every message comes a second time, a second later."""
    bare: bool = False
    """rmw_zenoh: messages come without their attachment."""
    battery_low: bool = False
    closed_s: float = Field(default=0.0, ge=0.0, le=60.0)
    """Leave the network for so long, then come back by itself."""
    watchdog_s: float = Field(default=CREATE3.watchdog_s, gt=0.0, le=5.0)
    """Of the base."""

    def changed(self, changes: object) -> Ros2Faults:
        """These with some values replaced. Raises ValueError in one line."""
        if not isinstance(changes, dict):
            raise ValueError("expected an object of faults")
        try:
            return Ros2Faults.model_validate({**self.model_dump(), **changes})
        except ValidationError as error:
            raise ValueError(first_problem(error)) from error

    def with_texts(self, items: list[str]) -> Ros2Faults:
        """These with `name=value` texts applied. Raises ValueError in one line."""
        changes = {}
        for item in items:
            name, equals, value = item.partition("=")
            if not equals:
                raise ValueError(f"expected NAME=VALUE, got {item!r}")
            changes[name] = value
        return self.changed(changes)
