"""Faults that an emulated ROS 2 robot can have, changed while it runs."""

import json
from typing import Literal

from pydantic import Field

from services.robot_driver.emulation.dynamics import CREATE3
from services.robot_driver.emulation.fault_set import FaultSet, texts
from shared.errors import ConfigError
from shared.foreign_bus import ForeignBus

FAULTS_KEY, TRUTH_KEY = "emulator/faults", "emulator/truth"
"""Keys for tests on the robot's network: faults as JSON, and what the robot really does."""


class Ros2Faults(FaultSet):
    """What is wrong with the robot or with the way to it. Frozen; the defaults are a sound one."""

    nobody_listens: bool = False
    """No node of the base takes velocities."""
    wrong_type: bool = False
    """The base listens for the other type of velocity."""
    odometry: Literal["", "frozen", "silent", "stalled", "constant"] = ""
    """frozen: the same message again and again; stalled: the motors do not turn, readings go on;
    constant: the same pose in new messages."""
    camera: Literal["", "frozen", "restamped", "silent", "noiseless", "flat"] = ""
    """frozen: the same message again and again; restamped: the same picture with new stamps;
    noiseless: equal pictures where it stands; flat: one grey alone."""
    camera_late_s: float = Field(default=0.0, ge=0.0, le=600.0)
    """Pictures have stamps so much older than they are."""
    bumper: Literal["", "stuck", "silent", "muted", "lifted"] = ""
    """stuck: pressed; silent: nobody publishes it; muted: its publisher is announced and says
    nothing; lifted: a wheel hangs in the air, where hazards are told."""
    payload: Literal["", "truncated", "big-endian", "padded"] = ""
    """What happens to the bytes of messages; big-endian and padded ones are still good."""
    payload_of: Literal["all", "odometry", "camera", "bumper", "battery"] = "all"
    duplicates: bool = False
    """Every message comes a second time, a second later."""
    bare: bool = False
    """rmw_zenoh: messages come without their attachment."""
    clock_step_s: float = Field(default=0.0, ge=-3600.0, le=3600.0)
    """The robot's clock is set by so much."""
    closed_s: float = Field(default=0.0, ge=0.0, le=60.0)
    """Leave the network for this time, then come back."""
    watchdog_s: float = Field(default=CREATE3.watchdog_s, gt=0.0, le=5.0)
    """Time after which the base stops by itself."""


def change_faults(endpoint: str, items: list[str]) -> str:
    """Change faults of a running emulator by `name=value` texts; returns them as JSON.

    Raises:
        ConfigError: A wrong name or value, or no emulator there.
        RouterMissing: Nothing answers at the endpoint.
    """
    try:
        changes = texts(items)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    bus = ForeignBus(endpoint)
    try:
        answer = bus.ask(FAULTS_KEY, json.dumps(changes).encode())
    finally:
        bus.close()
    if answer is None:
        raise ConfigError(f"no emulated robot answers at {endpoint}")
    return answer.decode()
