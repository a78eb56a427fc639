"""Says what is wrong without a flood: one line for each kind and minute, the others are counted."""

import time
from collections.abc import Callable

PERIOD_S = 60.0


class Complaints:
    """What one thread complains of. `say` writes a line. Kinds come from the code: they are few."""

    def __init__(
        self, say: Callable[[str], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._say, self._clock = say, clock
        self._next_s: dict[str, float] = {}
        self._held: dict[str, int] = {}

    def tell(self, kind: str, text: str) -> None:
        """Say the first of its kind in a minute, with the number of those not said before it."""
        now_s = self._clock()
        if now_s < self._next_s.get(kind, now_s):
            self._held[kind] = self._held.get(kind, 0) + 1
            return
        held = self._held.pop(kind, 0)
        self._next_s[kind] = now_s + PERIOD_S
        self._say(f"{text} ({held} more like this before)" if held else text)
