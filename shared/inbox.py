"""Keeps messages in bounded places for the one thread that owns them, decodes and acts."""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from collections.abc import Iterator
from typing import TYPE_CHECKING, TypeVar

from shared.codec import decode
from shared.errors import BadMessage
from shared.keys import Peer, Stream, check_sender
from shared.messages import Message

if TYPE_CHECKING:
    from shared.bus import Bus, Request

log = logging.getLogger(__name__)
M = TypeVar("M", bound=Message)
MAX_SENDERS = 64
"""Senders of one `latest` stream an inbox keeps apart; what comes of more is counted as busy."""


MAX_ANSWERS = 256
"""Answers to questions to all that are kept; newer ones replace the oldest."""


class Arrivals:
    """Lets one thread wait for what others put in. They hold `_ready` and call `_arrive`."""

    def __init__(self) -> None:
        self._ready = threading.Condition()
        self._arrivals = self._seen = 0

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

    def _arrive(self) -> None:
        self._arrivals += 1
        self._ready.notify_all()


class Inbox(Arrivals):
    """Messages that came for one thread. All methods but `wake` belong to that thread."""

    def __init__(self, bus: Bus) -> None:
        super().__init__()
        self._bus = bus
        self._latest: dict[tuple[str, str], bytes] = {}
        self._queues: dict[str, deque[Request]] = {}
        self.refused: Counter[str] = Counter()
        """Messages not taken, by stream: undecodable, oversized or badly addressed."""
        self.busy: Counter[str] = Counter()
        """Messages not taken because there was no room."""
        self._answers: deque[bytes] = deque(maxlen=MAX_ANSWERS)
        self._present: dict[tuple[str, str], set[str]] = {}

    def subscribe(self, stream: Stream, ident: str = "*") -> None:
        """Keep the newest message of every matching sender of a `latest` stream."""

        def keep(sender: str | None, data: bytes) -> None:
            with self._ready:
                slot = (stream.name, sender or "")
                if sender is None:
                    self.refused[stream.name] += 1
                elif slot not in self._latest and len(self._latest) >= MAX_SENDERS:
                    self.busy[stream.name] += 1
                else:
                    self._latest[slot] = data
                    self._arrive()

        self._bus.subscribe(stream, ident, keep)

    def serve(self, stream: Stream, ident: str = "main") -> None:
        """Queue the requests of a `request` stream; when full, answer "busy" at once.

        Of several streams, the requests of the one that was served first come first.
        """
        queue = self._queues.setdefault(stream.name, deque())

        def enqueue(request: Request) -> None:
            with self._ready:
                fits = 0 < request.size <= stream.max_bytes
                if fits and len(queue) < stream.queue:
                    queue.append(request)
                    self._arrive()
                    return
                (self.busy if fits else self.refused)[stream.name] += 1
            with request:
                expected = f"expected 1..{stream.max_bytes} bytes of payload"
                request.refuse("busy" if fits else expected, final=not fits)

        self._bus.serve(stream, ident, enqueue)

    def ask_all(
        self, stream: Stream, message: Message, *, ident: str = "main", timeout_s: float
    ) -> None:
        """Ask every other life that serves a stream; `answers` has what comes within the time."""

        def keep(data: bytes) -> None:
            with self._ready:
                self._answers.append(data)
                self._arrive()

        self._bus.ask_all(stream, message, keep, ident=ident, timeout_s=timeout_s)

    def answers(self, cls: type[M]) -> list[M]:
        """The answers that have come; what is no such message is left out, and logged."""
        with self._ready:
            raw = list(self._answers)
            self._answers.clear()
        answers = []
        for data in raw:
            try:
                answers.append(decode(data, cls))
            except BadMessage as error:
                log.warning("answer refused: %s", error)
        return answers

    def watch(self, service: str, ident: str = "*") -> None:
        """Keep whose lives are there; see `lives`."""

        def note(peer: Peer, here: bool) -> None:
            with self._ready:
                lives = self._present.setdefault((peer.service, peer.id), set())
                lives.add(peer.life) if here else lives.discard(peer.life)
                if not lives:
                    del self._present[peer.service, peer.id]
                self._arrive()

        self._bus.watch(service, ident, note)

    def lives(self, service: str, ident: str) -> frozenset[str]:
        """The lives that have a role now, as far as their tokens tell."""
        with self._ready:
            return frozenset(self._present.get((service, ident), ()))

    def take(self, stream: Stream, cls: type[M]) -> list[tuple[str, M]]:
        """The newest unread message of each sender of a `latest` stream, decoded."""
        with self._ready:
            slots = [slot for slot in self._latest if slot[0] == stream.name]
            raw = [(slot[1], self._latest.pop(slot)) for slot in slots]
        taken = []
        for sender, data in raw:
            try:
                message = decode(data, cls)
                check_sender(stream, sender, message)
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
                    request.refuse(f"bad message: {error}", final=True)
                continue
            yield request

    def _refuse(self, stream: Stream, error: BadMessage) -> None:
        with self._ready:
            self.refused[stream.name] += 1
            count = self.refused[stream.name]
        if count & (count - 1) == 0:  # 1, 2, 4, 8 ...: visible, never a flood
            log.warning("%s: message refused (%d so far): %s", stream.name, count, error)
