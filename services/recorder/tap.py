"""Hears every message of `latest` streams, in the order of arrival, for one thread."""

import time
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass

from shared.bus import Bus
from shared.inbox import Arrivals
from shared.keys import Stream

MAX_MESSAGES, MAX_BYTES = 20_000, 64 * 1024 * 1024
"""Most that waits at a tap."""


@dataclass(frozen=True)
class Heard:
    """A published message as it came: nothing of it is checked but its size and its key."""

    stream: Stream
    ident: str
    """Sender, as its key says."""
    time_ns: int
    """When it arrived, by the clock of this computer since 1970."""
    data: bytes


@dataclass(frozen=True)
class Version:
    """A version of the target network."""

    number: int
    time_ns: int
    """When it arrived."""
    data: bytes
    """As safetensors."""


class Tap(Arrivals):
    """Messages of these streams of a run from now on, for a thread that keeps up.

    At most `MAX_MESSAGES` of them and `MAX_BYTES` wait; what comes beyond that is lost and counted.
    """

    def __init__(self, bus: Bus, streams: Sequence[Stream]) -> None:
        super().__init__()
        self._waiting: deque[Heard] = deque()
        self._bytes = 0
        self.lost: Counter[str] = Counter()
        """Messages not taken, by stream: too many waiting, oversized or badly addressed."""
        for stream in streams:
            self._listen(bus, stream)

    def _listen(self, bus: Bus, stream: Stream) -> None:
        def keep(ident: str | None, data: bytes) -> None:
            with self._ready:
                size = len(data)
                room = len(self._waiting) < MAX_MESSAGES and self._bytes + size <= MAX_BYTES
                if ident is None or not room:
                    self.lost[stream.name] += 1
                    return
                self._waiting.append(Heard(stream, ident, time.time_ns(), data))
                self._bytes += size
                self._arrive()

        bus.subscribe(stream, "*", keep)

    def take(self, timeout_s: float) -> list[Heard]:
        """All that waits, as soon as there is something; empty at the timeout or when woken."""
        self.wait(timeout_s)
        with self._ready:
            taken = list(self._waiting)
            self._waiting.clear()
            self._bytes = 0
            return taken
