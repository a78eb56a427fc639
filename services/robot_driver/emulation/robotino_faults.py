"""Faults that an emulated Robotino can have, changed while it runs."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from services.robot_driver.emulation.dynamics import ROBOTINO
from services.robot_driver.emulation.fault_set import FaultSet


class Faults(FaultSet):
    """What is wrong with the robot or with the way to it. Frozen; the defaults are a sound one."""

    bumper: Literal["", "stuck", "unreadable", "nonsense"] = ""
    """stuck: pressed; unreadable: status 500; nonsense: an object without the value."""
    odometry: Literal["", "frozen", "stalled", "constant", "empty"] = ""
    """frozen: the same reading again and again; stalled: the motors do not turn, readings go on;
    constant: the same pose in new readings."""
    camera: Literal["", "frozen", "500", "truncated", "empty", "noiseless", "flat"] = ""
    """noiseless: equal pictures where it stands; flat: one grey alone."""
    stall_s: float = Field(default=0.0, ge=0.0, le=10.0)
    """Every answer comes so much later."""
    network: Literal["", "cut", "silent", "reset"] = ""
    """cut: connections are closed; silent: taken, never answered; reset: reset by the peer."""
    commands: Literal["", "refused"] = ""
    """refused: status 503 for velocities alone."""
    post_ignored: bool = False
    """As old images do: POST is answered and does nothing, PUT works."""
    watchdog_s: float = Field(default=ROBOTINO.watchdog_s, gt=0.0, le=5.0)
    """Time after which the base stops by itself: 0.2 s as documented, 0.5 s in older sources."""
