"""What flows on the bus: rate, size, age and content of every stream that can be watched.

Requests cannot: they go to the one who answers them. Of what is published, watchers see what the
table of streams gives them.
"""

import json
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from functools import partial

from rich.console import Console
from rich.table import Column, Table

from shared.bus import Bus
from shared.codec import decode
from shared.config import Config
from shared.errors import BadMessage, ConfigError, not_among
from shared.inbox import MAX_SENDERS
from shared.keys import STREAMS, check_sender
from shared.threads import stop_on_signals

PUBLISHED = {s.name: s for s in STREAMS if s.delivery == "latest" and "watcher" in s.receivers}
HIDDEN = [stream.name for stream in STREAMS if stream.name not in PUBLISHED]
COLUMNS = ("stream", "sender", "rate", "size", "age")
PERIOD_S, KEPT = 1.0, 256
"""How often rates are shown, and how many messages of each sender they are taken from."""


class Gauge:
    """Gathers what comes by some streams; any thread puts in, and one looks."""

    def __init__(self, streams: Iterable[str], clock: Callable[[], float] = time.monotonic) -> None:
        self._lock, self._clock, self._streams = threading.Lock(), clock, set(streams)
        self._heard: dict[tuple[str, str], deque[tuple[float, bytes]]] = {}
        """When each message of a sender of a stream came, and its bytes."""
        self._counts: Counter[tuple[str, str]] = Counter()

    def note(self, name: str, sender: str | None, payload: bytes) -> None:
        """Keep a message of a stream; `sender`: None for one that is too large."""
        place = (name, sender or "too large")
        with self._lock:
            if place in self._heard or len(self._heard) < MAX_SENDERS:
                kept = self._heard.setdefault(place, deque(maxlen=KEPT))
                kept.append((self._clock(), payload))
                self._counts[place] += 1
            else:
                self._counts["of more senders", ""] += 1

    def rows(self) -> Iterator[tuple[str, ...]]:
        """Stream, sender, rate, size, age and newest content, as words."""
        with self._lock:
            now_s, known = self._clock(), {place: [*kept] for place, kept in self._heard.items()}
        for (name, sender), kept in sorted(known.items()):
            rate = f"{(len(kept) - 1) / max(now_s - kept[0][0], 1e-6):.1f} Hz"
            size = f"{sum(len(data) for _, data in kept) / len(kept):.0f} bytes"
            age = f"{now_s - kept[-1][0]:.1f} s ago"
            yield name, sender, rate, size, age, content(name, sender, kept[-1][1])
        for name in sorted(self._streams - {name for name, _ in known}):
            yield name, "-", "not heard"
        if more := self._counts["of more senders", ""]:
            yield "of more senders", "-", f"{more} messages"

    def news(self) -> Iterator[str]:
        """What came since the last call, a line each, and how much came too fast."""
        with self._lock:
            taken, self._heard = self._heard, {}
            counts, self._counts = self._counts, Counter()
        for (name, sender), kept in taken.items():
            yield from (f"{sender} {content(name, sender, data)}" for _, data in kept)
            if lost := counts[name, sender] - len(kept):
                yield f"{sender}: {lost} came too fast to be shown"


def content(name: str, sender: str, payload: bytes) -> str:
    """A message of a stream as JSON; bytes are told by their number."""
    stream = PUBLISHED[name]
    try:
        message = decode(payload, stream.request)
        check_sender(stream, sender, message)
    except BadMessage as error:
        return json.dumps(f"no message: {error}")
    return json.dumps(message.model_dump(), default=lambda data: f"{len(data)} bytes")


def watch(config: Config, action: str, name: str, seconds: float) -> None:
    """Show rates of all streams or of one, or its messages (echo), until Ctrl-C or so long.

    Raises ConfigError for a stream that cannot be watched, RouterMissing.
    """
    if name in HIDDEN:
        raise ConfigError(f"{name}: cannot be watched, only who answers or receives it sees it")
    if name not in PUBLISHED and (name or action != "top"):
        raise not_among("stream", name, PUBLISHED)
    chosen = [name] if name else list(PUBLISHED)
    gauge, console = Gauge(chosen), Console(markup=False, emoji=False, highlight=False)
    with Bus(config.bus, config.run.name) as bus, stop_on_signals() as stop:
        for each in chosen:
            bus.subscribe(PUBLISHED[each], "*", partial(gauge.note, each))
        start_s = time.monotonic()
        while not stop.wait(PERIOD_S):
            if action == "echo":
                for line in gauge.news():
                    console.print(line, soft_wrap=True)
            else:
                columns = (*COLUMNS, Column("newest", no_wrap=True, ratio=1))
                hidden = f"not to be watched: {' '.join(HIDDEN)}"
                table = Table(*columns, box=None, pad_edge=False, caption=hidden, expand=True)
                for row in gauge.rows():
                    table.add_row(*row)
                console.clear()  # of a terminal only
                console.print(table)
            if seconds and time.monotonic() - start_s >= seconds:
                return
