"""Whether what a sensor sends is new, as far as the message itself tells (no clock, no thread)."""

from __future__ import annotations

import math
from collections import OrderedDict

import numpy as np
import numpy.typing as npt

from services.robot_driver.robot import Pose

NEW_CLOCK_NS = 10_000_000_000
"""A stamp older than the newest by more than this does not come late: the robot's clock was set
back. By less, and what comes is not new until the clock has caught up."""
MAX_SENDERS = 16
"""Publishers of one topic that are told apart; of more, the longest silent one is forgotten."""
MOVED_M, MOVED_RAD = 0.01, 0.02
"""A camera that sees the same to the last bit after this way is frozen."""


class Stamps:
    """The stamps of one topic: what repeats or is older than the newest is not new."""

    def __init__(self) -> None:
        self._newest = 0

    def new(self, stamp_ns: int) -> bool:
        """Whether a message with this stamp is newer than all before. 0: it tells no stamp."""
        if stamp_ns == 0:
            return True
        if self._newest - NEW_CLOCK_NS <= stamp_ns <= self._newest:
            return False
        self._newest = stamp_ns
        return True


class Sequences:
    """Sequence numbers of one topic by publisher: what repeats or comes late is not new."""

    def __init__(self) -> None:
        self._last: OrderedDict[bytes, int] = OrderedDict()

    def new(self, sender: bytes, sequence: int) -> bool:
        """Whether this number is higher than the last one of its sender."""
        if sequence <= self._last.get(sender, -1):
            return False
        self._last[sender] = sequence
        self._last.move_to_end(sender)
        if len(self._last) > MAX_SENDERS:
            self._last.popitem(last=False)
        return True


class Pictures:
    """Tells a frozen camera that goes on stamping: the robot moved, its picture did not change.

    A robot that stands still may see the same for long, in a simulation to the last bit.
    """

    def __init__(self) -> None:
        self._picture: npt.NDArray[np.uint8] | None = None
        self._since: Pose | None = None

    def new(self, picture: npt.NDArray[np.uint8], pose: Pose | None) -> bool:
        """Whether the camera still sees. pose: the newest odometry, None before the first."""
        if self._picture is None or not np.array_equal(self._picture, picture):
            self._picture, self._since = picture, pose
            return True
        if self._since is None:
            self._since = pose
        return pose is None or self._since is None or not _moved(self._since, pose)


def _moved(start: Pose, end: Pose) -> bool:
    turn = math.remainder(end.heading_rad - start.heading_rad, 2.0 * math.pi)
    return math.hypot(end.x_m - start.x_m, end.y_m - start.y_m) > MOVED_M or abs(turn) > MOVED_RAD
