"""Turns bytes of a terminal into keys, and keys into what a person wants. It has no clock."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

from shared.facts import FORWARD, FORWARD_LEFT, FORWARD_RIGHT
from shared.messages import Motion

DEADMAN_S = 0.3
"""Without another press of a key for so long the robot stops. Keyboards repeat faster."""
KeyCommand = Literal["", "estop", "quit"]
W = TypeVar("W")
MOTIONS: dict[str, Motion] = {
    "w": "forward",
    "s": "back",
    "a": "turn-left",
    "d": "turn-right",
    "up": "forward",
    "down": "back",
    "left": "turn-left",
    "right": "turn-right",
}
WISHES: dict[str, int | None] = {
    "w": FORWARD,
    "a": FORWARD_LEFT,
    "d": FORWARD_RIGHT,
    "up": FORWARD,
    "left": FORWARD_LEFT,
    "right": FORWARD_RIGHT,
}
"""Number of an action by its key."""
ARROWS = {"A": "up", "B": "down", "C": "right", "D": "left"}
ESCAPE = "\x1b"
LONGEST = 16
"""Characters of a sequence."""


class KeyParser:
    """Cuts what a terminal sends into keys; arrows are sequences, which may come in pieces."""

    def __init__(self) -> None:
        self._begun = ""

    def feed(self, data: bytes) -> list[str]:
        """The keys that are complete now: a character each, or the name of an arrow.

        Any other sequence, and ESC alone once the next key comes, is one key `escape`.
        """
        keys = (self._next(character) for character in data.decode("latin-1"))
        return [key for some in keys for key in some]

    def _next(self, character: str) -> list[str]:
        begun = self._begun
        if character == ESCAPE:
            self._begun = ESCAPE
            return ["escape"] if begun else []
        if not begun:
            return [character]
        if begun == ESCAPE and character in "[O":
            self._begun += character
            return []
        if begun != ESCAPE and " " <= character <= "?" and len(begun) < LONGEST:
            self._begun += character  # what modifies a key, such as Ctrl
            return []
        self._begun = ""
        if begun == ESCAPE:
            return ["escape", character]
        return [ARROWS.get(character, "escape") if len(begun) == len(ESCAPE) + 1 else "escape"]


@dataclass
class Wish(Generic[W]):
    """What the person at the keys wants now.

    What a key means is wanted for `DEADMAN_S` after it; any other key ends it at once.
    """

    meaning: Mapping[str, W]
    nothing: W
    """What is wanted without a key."""
    command: KeyCommand = ""
    """Last asked for; taken by `take_command`."""
    _wanted: W | None = None
    _until_s: float = -math.inf

    def press(self, key: str, now_s: float) -> None:
        """A key was pressed, or repeated."""
        key = key.lower()
        self._wanted = self.meaning.get(key)
        self._until_s = now_s + DEADMAN_S
        if key == "e":
            self.command = "estop"
        elif key == "q" and self.command != "estop":
            self.command = "quit"

    def now(self, now_s: float) -> W:
        """What is wanted."""
        if now_s >= self._until_s:
            self._wanted = None
        return self.nothing if self._wanted is None else self._wanted

    def take_command(self) -> KeyCommand:
        """What was asked for since the last call. An emergency stop goes before everything."""
        command, self.command = self.command, ""
        return command
