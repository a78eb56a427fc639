"""How a driver reaches a real robot: what its transport (HTTP, ROS 2) offers, and nothing more.

A link puts the newest readings into slots; `HardwareRobot` judges them and decides on motion.
"""

import logging
import threading
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

from services.robot_driver.robot import Pose, Velocity
from shared.messages import ImageArray

T = TypeVar("T")
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Reading(Generic[T]):
    """A reading and when it was made."""

    value: T
    stamp_s: float
    """When it was made, on the monotonic clock of this computer: the start of the request, or the
    stamp of the robot on our clock. What a robot repeats was not made again."""
    number: int
    """1 for the first reading of the slot, growing."""
    facts: str = ""
    """What people may want to know: encoding and size of a picture, how long it was on its way."""


class Newest(Generic[T]):
    """A slot that keeps the newest reading only; what it replaces was seen or not, nobody waits."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._reading: Reading[T] | None = None
        self._count = 0
        self.note = ""
        """Why there is no newer reading, as far as the link knows; empty when all is well."""

    def put(self, value: T, stamp_s: float, facts: str = "") -> None:
        """Replace the reading; called by the link, from any thread."""
        with self._changed:
            self._count += 1
            self._reading, self.note = Reading(value, stamp_s, self._count, facts), ""
            self._changed.notify_all()

    def void(self, note: str) -> None:
        """Forget the reading: what came since could not be read, so nothing is known any more."""
        with self._changed:
            self._reading, self.note = None, note

    def get(self) -> Reading[T] | None:
        """The newest reading; None before the first, and after `void`."""
        with self._changed:
            return self._reading

    def wait(self, number: int, timeout_s: float) -> Reading[T] | None:
        """The newest reading once it is past `number`; None when none came in time."""
        with self._changed:
            newer = self._changed.wait_for(
                lambda: self._reading is not None and self._reading.number > number, timeout_s
            )
            return self._reading if newer else None


@dataclass(frozen=True)
class Battery:
    """What the robot says of its battery."""

    low: bool | None
    """None where the robot does not tell, or tells what means nothing."""
    voltage_v: float | None
    """None where the robot does not tell, or tells nonsense."""
    charge: float | None = field(default=None, compare=False)
    """As told, a part of a full one or percent; None where the robot tells none."""


class Slots:
    """The slots of a link, and the count of what did not get into them."""

    def __init__(self) -> None:
        self.camera: Newest[ImageArray] = Newest()
        self.odometry: Newest[Pose] = Newest()
        self.bumper: Newest[bool] = Newest()
        self.battery: Newest[Battery] = Newest()
        self.faults: Counter[str] = Counter()
        self._counting = threading.Lock()

    def refuse(self, name: str, why: str, *, heard: bool = True) -> None:
        """Count what was no reading; heard of bumper or battery, it ends what was read before."""
        slot: Newest[Any] = getattr(self, name)
        if heard and name in ("bumper", "battery"):
            slot.void(why)
        slot.note = why
        self.count(name, why)

    def count(self, name: str, why: str) -> None:
        """Count by reason; log when the count is 1, 2, 4, 8 ...: visible, never a flood."""
        fault = f"{name}: {why.split(':')[0]}"
        with self._counting:
            self.faults[fault] += 1
            count = self.faults[fault]
        if count & (count - 1) == 0:
            log.warning("%s refused (%d so far): %s", name, count, why)


class Link(Protocol):
    """The transport of one robot. Pictures are preprocessed by it, at the edge (A22)."""

    camera: Newest[ImageArray]
    """uint8 [50, 75]."""
    odometry: Newest[Pose]
    """As the robot counts it, in metres and radians."""
    bumper: Newest[bool]
    """True: pressed. What cannot be read voids it; a read that fails puts nothing."""
    battery: Newest[Battery]
    faults: Counter[str]
    """Failed reads and writes, by what failed: `camera: status 500`, `bumper: timeout`."""

    def open(self) -> None:
        """Connect and begin to read. Raises RobotFault when no robot answers in time.

        Readings may come later or never: the robot stands without them, and says so.
        """

    def obstacle(self) -> str:
        """Why the robot cannot be commanded now, in one line; empty when it can."""

    def send(self, velocity: Velocity) -> None:
        """Send one command, newest wins; returns within a command period.

        Raises RobotFault: it could not be handed over; a later call may succeed.
        """

    def close(self) -> None:
        """Stop reading and disconnect; sends nothing. May be called twice."""
