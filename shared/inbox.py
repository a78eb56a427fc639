"""Keeps messages for one thread, in bounded places, until it takes them.

The bus's threads only put bytes in. The one thread that owns the inbox decodes and acts.
Undecodable, oversized and overflowing messages are counted by stream.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from collections.abc import Iterator
from typing import TYPE_CHECKING, TypeVar

from shared.codec import decode
from shared.errors import BadMessage
from shared.keys import Stream
from shared.messages import Message

if TYPE_CHECKING:
    from shared.bus import Bus, Request

log = logging.getLogger(__name__)
M = TypeVar("M", bound=Message)
MAX_SENDERS = 64
"""Senders of one `latest` stream an inbox keeps apart; more are refused and counted."""


class Inbox:
    """Messages that came for one thread. All methods but `wake` belong to that thread."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._ready = threading.Condition()
        self._arrivals = 0
        self._seen = 0
        self._latest: dict[tuple[str, str], bytes] = {}
        self._queues: dict[str, deque[Request]] = {}
        self.refused: Counter[str] = Counter()
        """Messages not taken, by stream: undecodable, oversized, badly addressed or overflowing."""

    def subscribe(self, stream: Stream, ident: str = "*") -> None:
        """Keep the newest message of every matching sender of a `latest` stream."""

        def keep(sender: str | None, data: bytes) -> None:
            with self._ready:
                slot = (stream.name, sender or "")
                full = slot not in self._latest and len(self._latest) >= MAX_SENDERS
                if sender is None or full:
                    self.refused[stream.name] += 1
                else:
                    self._latest[slot] = data
                    self._arrive()

        self._bus.subscribe(stream, ident, keep)

    def serve(self, stream: Stream, ident: str = "main") -> None:
        """Queue the requests of a `request` stream; when full, answer "busy" at once."""
        queue = self._queues.setdefault(stream.name, deque())

        def enqueue(request: Request) -> None:
            with self._ready:
                if not 0 < request.size <= stream.max_bytes:
                    problem = f"expected 1..{stream.max_bytes} bytes of payload"
                elif len(queue) >= stream.queue:
                    problem = "busy"
                else:
                    queue.append(request)
                    self._arrive()
                    return
                self.refused[stream.name] += 1
            with request:
                request.refuse(problem)

        self._bus.serve(stream, ident, enqueue)

    def wait(self, timeout_s: float) -> bool:
        """Wait until something arrives that was not waited for before; False at the timeout."""
        with self._ready:
            arrived = self._ready.wait_for(lambda: self._arrivals > self._seen, timeout_s)
            self._seen = self._arrivals
            return arrived

    def wake(self) -> None:
        """Let the owner's `wait` return (for shutdown; any thread)."""
        with self._ready:
            self._arrive()

    def take(self, stream: Stream, cls: type[M]) -> list[tuple[str, M]]:
        """The newest unread message of each sender of a `latest` stream, decoded."""
        with self._ready:
            slots = [slot for slot in self._latest if slot[0] == stream.name]
            raw = [(slot[1], self._latest.pop(slot)) for slot in slots]
        taken = []
        for sender, data in raw:
            try:
                message = decode(data, cls)
                if getattr(message, "robot", sender) != sender and "{id}" in stream.pattern:
                    raise BadMessage(f"{cls.__name__} of {message!r:.60} under the key of {sender}")
            except BadMessage as error:
                self._refuse(stream, error)
                continue
            taken.append((sender, message))
        return taken

    def requests(self) -> Iterator[Request]:
        """All requests queued now, decoded; those that are no valid message are answered so."""
        while True:
            with self._ready:
                queue = next((queue for queue in self._queues.values() if queue), None)
                if queue is None:
                    return
                request = queue.popleft()
            try:
                request.read()
            except BadMessage as error:
                self._refuse(request.stream, error)
                with request:
                    request.refuse(f"bad message: {error}")
                continue
            yield request

    @property
    def refused_total(self) -> int:
        """All messages not taken so far."""
        return sum(self.refused.values())

    def _refuse(self, stream: Stream, error: BadMessage) -> None:
        with self._ready:
            self.refused[stream.name] += 1
            count = self.refused[stream.name]
        if count & (count - 1) == 0:  # 1, 2, 4, 8 ...: visible, never a flood
            log.warning("%s: message refused (%d so far): %s", stream.name, count, error)

    def _arrive(self) -> None:
        self._arrivals += 1
        self._ready.notify_all()
