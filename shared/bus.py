"""Everything that touches Zenoh: sessions, publishing, inboxes, requests, liveliness.

Zenoh's callbacks only put bytes into bounded places of an `Inbox`; the one thread that owns the
inbox decodes and acts. Undecodable, oversized and overflowing messages are counted by stream.
"""

from __future__ import annotations

import json
import logging
import re
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self, TypeVar

import zenoh
from zenoh.handlers import FifoChannel

from shared.codec import decode, encode
from shared.config import BusConfig
from shared.errors import (
    BadMessage,
    ConfigError,
    PeerMissing,
    PeerRefused,
    PeerSilent,
    RouterMissing,
)
from shared.keys import Peer, Stream, alive_key, ident_in, parse_alive
from shared.messages import Message

log = logging.getLogger(__name__)
M = TypeVar("M", bound=Message)
MAX_SENDERS = 64
"""Senders of one `latest` stream an inbox keeps apart; more are refused and counted."""
TAP_MESSAGES, TAP_BYTES = 20_000, 64 * 1024 * 1024
"""Most that waits at a tap."""
REPLY_LIMIT = 16 * 1024 * 1024
"""Bytes of one reply; larger ones are refused."""


def zenoh_config(
    mode: str,
    *,
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    lease_ms: int = 2000,
    shared_memory: bool = True,
) -> zenoh.Config:
    """A closed configuration: no scouting, explicit endpoints, quick reconnection."""
    config = zenoh.Config()
    for key, value in {
        "mode": mode,
        "connect/endpoints": list(connect),
        "listen/endpoints": list(listen),
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "connect/timeout_ms": 1000,
        "connect/retry": {
            "period_init_ms": 50,
            "period_max_ms": 300,
            "period_increase_factor": 1.5,
        },
        "transport/link/tx/lease": lease_ms,
        "transport/shared_memory/enabled": shared_memory,
        "adminspace/enabled": mode == "router",
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


class Request:
    """One request waiting for its answer. Use as a context manager: leaving finishes it."""

    def __init__(self, stream: Stream, query: zenoh.Query, message: Message) -> None:
        self.stream, self.message, self._query = stream, message, query

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._query.drop()  # type: ignore[no-untyped-call]

    def reply(self, message: Message) -> None:
        """Send one answer; several are allowed where the stream says so."""
        self._query.reply(self._query.key_expr, encode(message))

    def refuse(self, reason: str) -> None:
        """Answer with an error in one line."""
        self._query.reply_err(reason.encode())


class Inbox:
    """Where messages for one thread arrive. All methods but the callbacks belong to that thread."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._ready = threading.Condition()
        self._arrivals = 0
        self._seen = 0
        self._latest: dict[tuple[str, str], bytes] = {}
        self._queues: dict[str, deque[zenoh.Query]] = {}
        self._streams: dict[str, Stream] = {}
        self.refused: Counter[str] = Counter()
        """Messages not taken, by stream: undecodable, oversized, badly addressed or overflowing."""

    def subscribe(self, stream: Stream, ident: str = "*") -> None:
        """Keep the newest message of every matching sender of a `latest` stream."""
        key = stream.wildcard(self._bus.run) if ident == "*" else stream.key(self._bus.run, ident)

        def on_sample(sample: zenoh.Sample) -> None:
            payload = sample.payload
            sender = ident_in(stream, str(sample.key_expr))
            with self._ready:
                slot = (stream.name, sender or "")
                full = slot not in self._latest and len(self._latest) >= MAX_SENDERS
                if sender is None or len(payload) > stream.max_bytes or full:
                    self.refused[stream.name] += 1
                    return
                self._latest[slot] = payload.to_bytes()
                self._arrivals += 1
                self._ready.notify_all()

        self._bus.subscriber(key, on_sample)

    def serve(self, stream: Stream, ident: str = "main") -> None:
        """Queue the requests of a `request` stream; when full, answer "busy" at once."""
        queue = self._queues.setdefault(stream.name, deque())
        self._streams[stream.name] = stream

        def on_query(query: zenoh.Query) -> None:
            payload = query.payload
            with self._ready:
                if payload is None or len(payload) > stream.max_bytes:
                    self.refused[stream.name] += 1
                    problem = f"expected 1..{stream.max_bytes} bytes of payload"
                elif len(queue) >= stream.queue:
                    self.refused[stream.name] += 1
                    problem = "busy"
                else:
                    queue.append(query)
                    self._arrivals += 1
                    self._ready.notify_all()
                    return
            query.reply_err(problem.encode())
            query.drop()  # type: ignore[no-untyped-call]

        self._bus.queryable(stream.key(self._bus.run, ident), on_query)

    def wait(self, timeout_s: float) -> bool:
        """Wait until something arrives that was not waited for before; False at the timeout."""
        with self._ready:
            arrived = self._ready.wait_for(lambda: self._arrivals > self._seen, timeout_s)
            self._seen = self._arrivals
            return arrived

    def wake(self) -> None:
        """Let the owner's `wait` return (for shutdown; any thread)."""
        with self._ready:
            self._arrivals += 1
            self._ready.notify_all()

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
                name = next((name for name, queue in self._queues.items() if queue), None)
                if name is None:
                    return
                query = self._queues[name].popleft()
            stream = self._streams[name]
            try:
                payload = query.payload
                message: Message = decode(payload.to_bytes() if payload else b"", stream.request)
            except BadMessage as error:
                self._refuse(stream, error)
                query.reply_err(f"bad message: {error}".encode())
                query.drop()  # type: ignore[no-untyped-call]
                continue
            yield Request(stream, query, message)

    def _refuse(self, stream: Stream, error: BadMessage) -> None:
        with self._ready:
            self.refused[stream.name] += 1
            count = self.refused[stream.name]
        if count & (count - 1) == 0:  # 1, 2, 4, 8 ...: visible, never a flood
            log.warning("%s: message refused (%d so far): %s", stream.name, count, error)

    @property
    def refused_total(self) -> int:
        """All messages not taken so far."""
        return sum(self.refused.values())


@dataclass(frozen=True)
class Heard:
    """A published message as it came: nothing of it is checked but its size and its key."""

    stream: Stream
    ident: str
    """Of the sender, from the key."""
    time_ns: int
    """When it arrived, by the clock of this computer since 1970."""
    data: bytes


class Tap:
    """Every message of `latest` streams, in the order of arrival, for one thread that keeps up.

    At most `TAP_MESSAGES` of them and `TAP_BYTES` wait; what comes beyond that is lost and counted.
    """

    def __init__(self, bus: Bus, streams: Sequence[Stream]) -> None:
        self._bus = bus
        self._ready = threading.Condition()
        self._waiting: deque[Heard] = deque()
        self._bytes = 0
        self._woken = False
        self.lost: Counter[str] = Counter()
        """Messages not taken, by stream: too many waiting, oversized or badly addressed."""
        for stream in streams:
            self._listen(stream)

    def _listen(self, stream: Stream) -> None:
        def on_sample(sample: zenoh.Sample) -> None:
            payload = sample.payload
            ident = ident_in(stream, str(sample.key_expr))
            with self._ready:
                size = len(payload)
                room = len(self._waiting) < TAP_MESSAGES and self._bytes + size <= TAP_BYTES
                if ident is None or size > stream.max_bytes or not room:
                    self.lost[stream.name] += 1
                    return
                self._waiting.append(Heard(stream, ident, time.time_ns(), payload.to_bytes()))
                self._bytes += size
                self._ready.notify_all()

        self._bus.subscriber(stream.wildcard(self._bus.run), on_sample)

    def take(self, timeout_s: float) -> list[Heard]:
        """All that waits, as soon as there is something; empty at the timeout or when woken."""
        with self._ready:
            self._ready.wait_for(lambda: bool(self._waiting) or self._woken, timeout_s)
            self._woken = False
            taken = list(self._waiting)
            self._waiting.clear()
            self._bytes = 0
            return taken

    def wake(self) -> None:
        """Let `take` return (any thread)."""
        with self._ready:
            self._woken = True
            self._ready.notify_all()


class Bus:
    """One Zenoh session of one run. Use as a context manager: an unclosed session never exits."""

    def __init__(self, config: BusConfig, run: str) -> None:
        """Connect to the router. Raises RouterMissing when none answers within about a second."""
        self.run, self.config = run, config
        self._declared: list[Any] = []
        self._publishers: dict[str, zenoh.Publisher] = {}
        try:
            self._session = zenoh.open(
                zenoh_config(
                    "client",
                    connect=[config.endpoint],
                    lease_ms=config.lease_ms,
                    shared_memory=config.shared_memory,
                )
            )
        except zenoh.ZError as error:
            raise RouterMissing(f"no Zenoh router at {config.endpoint}: {error}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Undeclare everything and leave; may be called twice."""
        self._session.close()  # type: ignore[no-untyped-call]

    def inbox(self) -> Inbox:
        """A new inbox for one thread."""
        return Inbox(self)

    def tap(self, streams: Sequence[Stream]) -> Tap:
        """Hear everything of these `latest` streams from now on."""
        return Tap(self, streams)

    def subscriber(self, key: str, callback: Any) -> None:
        """Declare a subscriber that lives as long as the bus.

        The callback runs on Zenoh's own thread, one change of threads nearer to who waits for the
        message: it must only enqueue.
        """
        direct = zenoh.handlers.Callback(callback, indirect=False)
        self._declared.append(self._session.declare_subscriber(key, direct))

    def queryable(self, key: str, callback: Any) -> None:
        """Declare a queryable that lives as long as the bus."""
        self._declared.append(self._session.declare_queryable(key, callback, complete=True))

    def publish(self, stream: Stream, message: Message, ident: str = "main") -> None:
        """Publish to a `latest` stream. Never blocks; what nobody receives is lost by design."""
        key = stream.key(self.run, ident)
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self._publishers[key] = self._session.declare_publisher(
                key, express=True, congestion_control=zenoh.CongestionControl.DROP
            )
        publisher.put(encode(message))

    def request(
        self,
        stream: Stream,
        message: Message,
        cls: type[M],
        *,
        ident: str = "main",
        timeout_s: float | None = None,
    ) -> M:
        """Ask once and return the one answer.

        Raises PeerMissing, PeerSilent, PeerRefused or BadMessage; asking again is up to the caller.
        """
        return next(iter(self.request_many(stream, message, cls, ident=ident, timeout_s=timeout_s)))

    def request_many(
        self,
        stream: Stream,
        message: Message,
        *types: type[M],
        ident: str = "main",
        timeout_s: float | None = None,
    ) -> Iterator[M]:
        """Ask once and yield the answers as they come. Raises like `request`.

        Zenoh ends a broken transfer without an error: the caller checks that it is complete.
        """
        key = stream.key(self.run, ident)
        replies = self._session.get(
            key,
            FifoChannel(64),
            payload=encode(message),
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.BLOCK,
            timeout=timeout_s or self.config.request_timeout_s,
        )
        answered = False
        for reply in replies:
            answered = True
            if reply.ok is None:
                text = reply.err.payload.to_string() if reply.err else "unknown error"
                raise (
                    PeerSilent(f"{key}: no answer in time")
                    if text == "Timeout"
                    else PeerRefused(f"{key}: {text}")
                )
            payload = reply.ok.payload
            if len(payload) > REPLY_LIMIT:
                raise BadMessage(f"{key}: reply of {len(payload)} bytes, at most {REPLY_LIMIT}")
            yield decode(payload.to_bytes(), *types)
        if not answered:
            raise PeerMissing(f"{key}: nobody answers")

    def announce(self, service: str, ident: str, life: str, protocol: int, config: str) -> None:
        """Declare the liveliness token that tells others who is there."""
        key = alive_key(self.run, service, ident, life, protocol, config)
        self._declared.append(self._session.liveliness().declare_token(key))

    def peers(self, timeout_s: float = 2.0) -> list[Peer]:
        """Everybody alive in this run now (empty without a router)."""
        replies = self._session.liveliness().get(f"{self.run}/alive/**", timeout=timeout_s)
        peers = (parse_alive(str(reply.ok.key_expr)) for reply in replies if reply.ok)
        return sorted((peer for peer in peers if peer), key=lambda peer: (peer.service, peer.id))


@contextmanager
def open_router(endpoint: str) -> Iterator[str]:
    """Be a Zenoh router while the block runs; yields the locator it listens on.

    Args:
        endpoint: where to listen, such as `tcp/127.0.0.1:7447`; port 0 takes a free one.

    Raises:
        ConfigError: it cannot listen there, for instance because the port is in use.
    """
    try:
        session = zenoh.open(zenoh_config("router", listen=[endpoint]))
    except zenoh.ZError as error:
        reason = re.sub(r" at \S+\.rs:\d+\.?", "", str(error))
        raise ConfigError(f"router: cannot listen on {endpoint!r}: {reason}") from error
    try:
        yield locator(session, endpoint)
    finally:
        session.close()  # type: ignore[no-untyped-call]


def locator(session: zenoh.Session, endpoint: str) -> str:
    """Where a session in router mode really listens: `endpoint` with its port filled in."""
    replies = session.get(f"@/{session.zid()}/router", timeout=5.0)
    answers = [json.loads(reply.ok.payload.to_string()) for reply in replies if reply.ok]
    return str(answers[0]["locators"][0]) if answers and answers[0]["locators"] else endpoint
