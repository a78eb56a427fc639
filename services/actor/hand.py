"""Whether a person drives a robot in place of the network, and what they want now. No clock."""

from pathlib import Path
from typing import Literal

from shared.messages import Takeover

WISH_S = 0.3
"""How long a wish for an action holds; a commander says it again more often."""
HOLD_AFTER = 0.7
"""Part of a period after which a robot that stands anyway is told to hold."""
HOLDER_SILENT_S = 3.0
"""After this time another person may take the robot over, or give it back."""


class Hand:
    """Who took the robot over keeps it until it is given back; one person drives at a time.

    path: is there while the robot is taken over, so that no restart lets the network drive.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.taken = path.exists()
        self.life = ""
        """Which commander was heard last."""
        self.refused = 0
        """Messages of another person than the one who drives, or out of order."""
        self._number = -1
        self._heard_s = float("-inf")
        self._action: int | None = None
        self.chosen: int | None = None
        """The person's action that is to be taken now."""
        self._moves = False
        """Whether the last answer was an action."""
        self._look_s = self._act_s = 0.0

    def note(self, wish: Takeover, now_s: float) -> None:
        """Take a message, which counts as made now.

        Raises OSError when a restart could not know of it; it holds all the same.
        """
        if wish.life != self.life:
            if self.taken and self.silent_s(now_s) < HOLDER_SILENT_S:
                self.refused += 1
                return
            self.life, self._number = wish.life, -1
        if wish.number <= self._number:
            self.refused += 1
            return
        self._number, self._heard_s, self._action = wish.number, now_s, wish.action
        before, self.taken = self.taken, not wish.give_back
        if wish.give_back:
            self._path.unlink(missing_ok=True)
        elif not before:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._path.touch()

    def looked(self, now_s: float) -> None:
        """The robot sent an observation that it was not asked about before."""
        self._look_s = now_s

    def acted(self, now_s: float) -> None:
        """It was answered with an action."""
        self._moves, self._act_s = True, now_s

    def held(self) -> None:
        """It was told to stand."""
        self._moves = False

    def turn(
        self, now_s: float, period_s: float, *, realtime: bool
    ) -> Literal["act", "wait", "hold"]:
        """What becomes of the newest observation now; act: as `chosen`, no faster than real time.

        A robot that stands is told to hold only as its period ends: a wish before is not late then.
        """
        wish = self.wish(now_s)
        if wish is not None and (realtime or now_s - self._act_s >= period_s):
            self.chosen = wish
            return "act"
        due = self._moves or now_s - self._look_s > HOLD_AFTER * period_s
        return "hold" if due else "wait"

    def silent_s(self, now_s: float) -> float:
        """How long nothing was heard; without end before the first message."""
        return now_s - self._heard_s

    def wish(self, now_s: float) -> int | None:
        """The action that the person wants now; None: the robot is to stand."""
        return self._action if self.taken and self.silent_s(now_s) < WISH_S else None
