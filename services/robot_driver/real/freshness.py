"""Whether what a sensor sends is new, and when it was made (no clock, no thread)."""

import math
from collections import OrderedDict, deque

import numpy as np
import numpy.typing as npt

from services.robot_driver.robot import Pose

DRIFT = 1e-3
"""Fastest that two clocks drift apart, in seconds a second."""
SET_ROW = 4
"""Messages in a row of another time, ascending, after which a clock was set."""
AHEAD_S, RECENT_S = 0.5, 10.0
"""So long after a clock was set back, messages that seem so much faster than the fastest are still
of the time before."""
SEEN_S = 2.0
"""Stamps of the last seconds are remembered: a copy never shows that a clock was set back."""
MAX_SENDERS = 16
"""Publishers of one topic that are told apart; of more, the longest silent one is forgotten."""
MOVED_M, MOVED_RAD = 0.01, 0.02
"""A camera that sees the same to the last bit after this way is frozen."""
REST_S = 2.0
"""A robot that stood for this long may see the same again, for the first time; then for twice as
long each time, so that a frozen camera moves no robot on and on."""


class RobotClock:
    """The robot's clock against ours, from stamps and arrivals of all its messages.

    The message of the shortest way tells; how far they are apart rises as slowly as clocks drift.
    """

    def __init__(self) -> None:
        self.settings = 0
        """How often the robot's clock was set."""
        self.apart_s: float | None = None
        """Ours less the robot's; None before the first stamp."""
        self.told_s = 0.0
        """When a message last came whose stamp fits."""
        self._set_s = -math.inf

    def made_s(self, stamp_ns: int, arrived_s: float) -> float:
        """When a message was made, on our clock. Without a stamp (0): when it arrived."""
        if stamp_ns == 0:
            return arrived_s
        apart_s = arrived_s - stamp_ns / 1e9
        if self.apart_s is not None:
            drift_s = DRIFT * max(arrived_s - self.told_s, 0.0)
            apart_s = min(apart_s, self.apart_s + drift_s)
        self.apart_s, self.told_s = apart_s, arrived_s
        return min(stamp_ns / 1e9 + apart_s, arrived_s)

    def of_before(self, stamp_ns: int, arrived_s: float) -> bool:
        """Whether a stamp is of the time before the clock was set back a while ago."""
        if self.apart_s is None or arrived_s - self._set_s > RECENT_S:
            return False
        return arrived_s - stamp_ns / 1e9 < self.apart_s - AHEAD_S

    def set_back(self, now_s: float) -> None:
        """The robot's clock was set back: what was known of it is void."""
        self.settings, self.apart_s, self._set_s = self.settings + 1, None, now_s

    def stamp_ns(self, now_s: float) -> int:
        """Now on the robot's clock, never ahead of it; 0 (no stamp) before the first message."""
        return 0 if self.apart_s is None else round((now_s - self.apart_s) * 1e9)


class Stamps:
    """The stamps of one topic: what repeats or is older than the newest is not new.

    clock: of the computer that stamps it. Topics that share it learn of each other when it was set.
    """

    def __init__(self, clock: RobotClock) -> None:
        self._clock = clock
        self._settings = clock.settings
        self._newest = 0
        self._row: list[tuple[int, float]] = []
        """Messages since the newest that may be of a clock that was set."""
        self._seen: deque[tuple[int, float]] = deque(maxlen=512)
        self.copied = False
        """Whether the message judged last was a copy of one before."""

    def made_s(self, stamp_ns: int, arrived_s: float) -> float | None:
        """When a message was made, on our clock; None when it repeats or comes late."""
        if not stamp_ns:
            return arrived_s
        while self._seen and arrived_s - self._seen[0][1] > SEEN_S:
            self._seen.popleft()
        self.copied = stamp_ns == self._newest or any(stamp_ns == seen for seen, _ in self._seen)
        if self.copied:
            self._row = []
            return None
        if self._settings != self._clock.settings:
            self._settings, self._newest = self._clock.settings, 0
        if stamp_ns < self._newest or self._clock.of_before(stamp_ns, arrived_s):
            if not self._in_order(stamp_ns, arrived_s):
                return None
            self._clock.set_back(arrived_s)
            self._settings = self._clock.settings
        self._newest, self._row = stamp_ns, []
        self._seen.append((stamp_ns, arrived_s))
        return self._clock.made_s(stamp_ns, arrived_s)

    def _in_order(self, stamp_ns: int, arrived_s: float) -> bool:
        """Whether enough such messages ascend, and no faster than they arrive: no late burst.

        Nor may another topic have gone on meanwhile: then the messages are old.
        """
        if self._row and stamp_ns <= self._row[-1][0]:
            self._row = []
        self._row = [*self._row[-SET_ROW:], (stamp_ns, arrived_s)]
        first_ns, first_s = self._row[0]
        enough = len(self._row) >= SET_ROW
        enough &= self._clock.told_s <= first_s
        return enough and arrived_s - first_s >= 0.5e-9 * (stamp_ns - first_ns)


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
    """Tells a frozen camera that goes on sending: the robot moved, its picture did not change.

    A robot that stands still may see the same for long, and after it moved before a plain wall.
    """

    def __init__(self) -> None:
        self._picture: npt.NDArray[np.uint8] | None = None
        self._since: Pose | None = None
        self._rest_s = REST_S
        self._here: tuple[Pose, float] | None = None
        """Where the robot stands, and since when."""

    def new(self, picture: npt.NDArray[np.uint8], pose: Pose | None, now_s: float) -> bool:
        """Whether the camera still sees. pose: the newest odometry, None before the first."""
        if pose is not None and (self._here is None or _moved(self._here[0], pose)):
            self._here = (pose, now_s)
        if self._picture is None or not np.array_equal(self._picture, picture):
            self._picture, self._since, self._rest_s = picture, pose, REST_S
            return True
        self._since = self._since or pose
        if pose is None or self._since is None or not _moved(self._since, pose):
            return True
        if self._here is None or now_s - self._here[1] < self._rest_s:
            return False
        self._since, self._rest_s = pose, 2.0 * self._rest_s
        return True


def _moved(start: Pose, end: Pose) -> bool:
    turn = math.remainder(end.heading_rad - start.heading_rad, 2.0 * math.pi)
    return math.hypot(end.x_m - start.x_m, end.y_m - start.y_m) > MOVED_M or abs(turn) > MOVED_RAD
