"""How a driver reaches a real robot: what its transport (HTTP, ROS 2) offers, and nothing more.

A link has threads or callbacks of its own that put the newest readings into slots; `HardwareRobot`
(`hardware.py`) takes them out, judges their age, and owns every decision about motion.
"""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from services.robot_driver.robot import Pose, Velocity
from shared.messages import ImageArray

T = TypeVar("T")


@dataclass(frozen=True)
class Reading(Generic[T]):
    """A reading and when it was new."""

    value: T
    stamp_s: float
    """Monotonic clock of this computer, when the reading arrived. A reading that tells its own
    sequence number or stamp and repeats it did not arrive again."""
    number: int
    """1 for the first reading of the slot, growing."""


class Newest(Generic[T]):
    """A slot that keeps the newest reading only; what it replaces was seen or not, nobody waits."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._reading: Reading[T] | None = None

    def put(self, value: T, stamp_s: float) -> None:
        """Replace the reading; called by the link, from any thread."""
        with self._changed:
            number = self._reading.number + 1 if self._reading else 1
            self._reading = Reading(value, stamp_s, number)
            self._changed.notify_all()

    def get(self) -> Reading[T] | None:
        """The newest reading; None before the first."""
        with self._changed:
            return self._reading

    def wait(self, number: int, timeout_s: float) -> Reading[T] | None:
        """The newest reading once it is past `number`; None when none came in time."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._reading is not None and self._reading.number > number, timeout_s
            )
            newer = self._reading is not None and self._reading.number > number
            return self._reading if newer else None


@dataclass(frozen=True)
class Battery:
    """What the robot says of its battery."""

    low: bool
    voltage_v: float | None
    """None where the robot does not tell, or tells nonsense."""


class Link(Protocol):
    """The transport of one robot. Pictures are preprocessed by it, at the edge (A22)."""

    camera: Newest[ImageArray]
    """uint8 [50, 75]."""
    odometry: Newest[Pose]
    """As the robot counts it, in metres and radians."""
    bumper: Newest[bool]
    """True: pressed. A failed read puts nothing."""
    battery: Newest[Battery]
    faults: Counter[str]
    """Failed reads and writes, by what failed: `camera: status 500`, `bumper: timeout`."""

    def open(self) -> None:
        """Connect and begin to read. Raises RobotFault when no robot answers in time."""

    def obstacle(self) -> str:
        """Why the robot cannot be commanded now, in one line; empty when it can."""

    def send(self, velocity: Velocity) -> None:
        """Send one command, newest wins; returns within a command period.

        Raises:
            RobotFault: It could not be handed over; a later call may succeed.
        """

    def close(self) -> None:
        """Stop reading and disconnect; sends nothing. May be called twice."""
