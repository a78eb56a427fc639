"""Everything that touches Zenoh: sessions, publishing, subscribing, requests, liveliness."""

import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self, TypeVar

import zenoh
from zenoh.handlers import FifoChannel

from shared.codec import decode, encode
from shared.config import BusConfig
from shared.errors import (
    BadMessage,
    BusError,
    ConfigError,
    PeerMissing,
    PeerRefused,
    PeerSilent,
    RouterMissing,
)
from shared.inbox import Inbox
from shared.keys import CLAIM_PATTERN, Peer, Stream, alive_key, check_sender, ident_in, parse_alive
from shared.messages import Message, Refusal
from shared.threads import LONGEST_S, paced
from shared.zenoh_settings import encrypted, locator, opened, zenoh_config

M = TypeVar("M", bound=Message)
REPLY_LIMIT = 16 * 1024 * 1024
"""Bytes of one reply; larger ones are refused."""


class Request:
    """One request waiting for its answer. Use as a context manager: leaving finishes it."""

    message: Message
    """The question, as soon as `read` has returned."""

    def __init__(self, stream: Stream, query: zenoh.Query, ident: str) -> None:
        self.stream, self._query, self.ident = stream, query, ident

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._query.drop()  # type: ignore[no-untyped-call]

    @property
    def size(self) -> int:
        """Bytes of the message."""
        return len(self._query.payload or b"")

    def read(self) -> None:
        """Decode the message. Raises BadMessage, also if it is of another robot than its key."""
        payload = self._query.payload
        self.message = decode(payload.to_bytes() if payload else b"", self.stream.request)
        check_sender(self.stream, self.ident, self.message)

    def reply(self, message: Message) -> None:
        """Send one answer; several are allowed where the stream says so."""
        self._query.reply(self._query.key_expr, encode(message))

    def refuse(self, reason: str, *, final: bool = False) -> None:
        """Answer with an error in one line; final: the same request will be refused again."""
        self._query.reply_err(encode(Refusal(final=final, reason=reason[:300])))


class Bus:
    """One Zenoh session of one run. Use as a context manager: an unclosed session never exits."""

    def __init__(self, config: BusConfig, run: str) -> None:
        """Connect to the router. Raises RouterMissing when none answers within about a second."""
        self.run, self.config = run, config
        self._declared: list[Any] = []
        self._publishers: dict[str, zenoh.Publisher] = {}
        try:
            self._session = opened(
                zenoh_config(
                    "client",
                    connect=[config.endpoint],
                    lease_ms=config.lease_ms,
                    shared_memory=config.shared_memory,
                    credentials=config.credentials,
                )
            )
        except zenoh.ZError as error:
            takes = f" that takes the credentials in {config.credentials}"
            there = config.endpoint + takes * bool(config.credentials)
            raise RouterMissing(f"no Zenoh router at {there}: {error}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Undeclare everything and leave; may be called twice."""
        self._session.close()  # type: ignore[no-untyped-call]

    @property
    def connected(self) -> bool:
        """Whether a router answers now; one that is gone or hangs counts until its lease ends."""
        return bool(self.router)

    @property
    def router(self) -> str:
        """Which router answers now; another one after it was restarted. Empty without one."""
        return " ".join(map(str, self._session.info.routers_zid()))

    def inbox(self) -> Inbox:
        """A new inbox for one thread."""
        return Inbox(self)

    def subscribe(
        self, stream: Stream, ident: str, receive: Callable[[str | None, bytes], None]
    ) -> None:
        """Receive the messages of one sender of a `latest` stream, or of all (`*`).

        `receive` takes sender and bytes of a message; None and no bytes where the key is of no
        sender or the message too large. It runs on Zenoh's own thread: it must only enqueue.
        """
        key = stream.wildcard(self.run) if ident == "*" else stream.key(self.run, ident)

        def on_sample(sample: zenoh.Sample) -> None:
            sender = ident_in(stream, str(sample.key_expr))
            if sender is None or len(sample.payload) > stream.max_bytes:
                receive(None, b"")
            else:
                receive(sender, sample.payload.to_bytes())

        direct = zenoh.handlers.Callback(on_sample, indirect=False)
        self._declared.append(self._session.declare_subscriber(key, direct))

    def serve(self, stream: Stream, ident: str, receive: Callable[[Request], None]) -> None:
        """Receive the requests of a `request` stream, of one id or of all (`*`).

        `receive` must only enqueue. A request must name the concrete key: an answer to a wildcard
        could be anybody's.
        """
        key = stream.wildcard(self.run) if ident == "*" else stream.key(self.run, ident)

        def on_query(query: zenoh.Query) -> None:
            named = ident_in(stream, str(query.key_expr))
            request = Request(stream, query, named or "")
            if named is not None:
                receive(request)
                return
            with request:
                request.refuse(f"expected a request for a concrete key like {key}", final=True)

        self._declared.append(self._session.declare_queryable(key, on_query, complete=True))

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
        """Ask once for one answer. Raises PeerMissing, PeerSilent, PeerRefused or BadMessage."""
        return next(iter(self.request_many(stream, message, cls, ident=ident, timeout_s=timeout_s)))

    def request_many(
        self,
        stream: Stream,
        message: Message,
        *types: type[M],
        ident: str = "main",
        timeout_s: float | None = None,
        patience_s: float = 0.0,
        everybody: bool = False,
    ) -> Iterator[M]:
        """Ask once and yield the answers as they come. Raises like `request`.

        Zenoh ends a broken transfer without an error: the caller checks that it is complete. With
        `patience_s` each answer has so long to come, in place of all together. With `everybody` it
        asks all who serve the stream, and errors of some do not matter.
        """
        key, token = stream.key(self.run, ident), zenoh.CancellationToken()
        limit_s = LONGEST_S if patience_s else timeout_s or self.config.request_timeout_s
        replies = self._session.get(
            key,
            FifoChannel(64),
            payload=encode(message),
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.BLOCK,
            timeout=limit_s,
            cancellation_token=token,
            target=zenoh.QueryTarget.ALL if everybody else zenoh.QueryTarget.BEST_MATCHING,
        )
        answered = False
        try:
            for reply in paced(replies, patience_s, token.cancel) if patience_s else replies:
                if reply.ok is None and everybody:
                    continue
                answered = True
                yield decode(_payload(key, reply), *types)
        finally:
            del replies  # or its full queue would hold up the cancelling
            token.cancel()  # type: ignore[no-untyped-call]
        if not answered:
            raise PeerMissing(f"{key}: nobody answers")

    def ask_all(
        self,
        stream: Stream,
        message: Message,
        receive: Callable[[bytes], None],
        *,
        ident: str = "main",
        timeout_s: float,
    ) -> None:
        """Ask every other life that serves a stream. `receive` must only enqueue bytes."""

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None and len(reply.ok.payload) <= REPLY_LIMIT:
                receive(reply.ok.payload.to_bytes())

        self._session.get(
            stream.key(self.run, ident),
            on_reply,
            payload=encode(message),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
            allowed_destination=zenoh.Locality.REMOTE,
            timeout=timeout_s,
        )

    def announce(self, service: str, ident: str, life: str, protocol: int, config: str) -> None:
        """Declare the liveliness token that tells others who is there."""
        key = alive_key(self.run, service, ident, life, protocol, config)
        self._declared.append(self._session.liveliness().declare_token(key))

    def peers(self, service: str = "*", ident: str = "*", timeout_s: float = 2.0) -> list[Peer]:
        """Everybody alive in this run now (empty without a router)."""
        key = f"{self.run}/alive/{service}/{ident}/**"
        replies = self._session.liveliness().get(key, timeout=timeout_s)
        peers = {parse_alive(str(reply.ok.key_expr)) for reply in replies if reply.ok}
        return sorted((peer for peer in peers if peer), key=lambda peer: (peer.service, peer.id))

    def watch(self, service: str, ident: str, receive: Callable[[Peer, bool], None]) -> None:
        """Hear of peers that are there, come and go. `receive` must only enqueue."""

        def on_sample(sample: zenoh.Sample) -> None:
            if (peer := parse_alive(str(sample.key_expr))) is not None:
                receive(peer, sample.kind == zenoh.SampleKind.PUT)

        key = f"{self.run}/alive/{service}/{ident}/**"
        liveliness = self._session.liveliness()
        self._declared.append(liveliness.declare_subscriber(key, on_sample, history=True))

    @contextmanager
    def claiming(self, service: str, ident: str, life: str) -> Iterator[None]:
        """Have the token of a process that wants a role while the block runs."""
        token = self._session.liveliness().declare_token(
            CLAIM_PATTERN.format(run=self.run, service=service, id=ident, life=life)
        )
        try:
            yield
        finally:
            token.undeclare()  # type: ignore[no-untyped-call]

    def claims(self, service: str, ident: str, timeout_s: float = 2.0) -> set[str]:
        """Lives of the processes that want a role now."""
        key = CLAIM_PATTERN.format(run=self.run, service=service, id=ident, life="*")
        replies = self._session.liveliness().get(key, timeout=timeout_s)
        return {str(reply.ok.key_expr).split("/")[-1] for reply in replies if reply.ok}


def _payload(key: str, reply: zenoh.Reply) -> bytes:
    """The bytes of an answer. Raises BusError for an error, BadMessage for one too large."""
    if reply.ok is None:
        raise _failure(key, reply.err.payload.to_bytes() if reply.err else b"")
    if len(reply.ok.payload) > REPLY_LIMIT:
        raise BadMessage(f"{key}: reply of {len(reply.ok.payload)} bytes, at most {REPLY_LIMIT}")
    return reply.ok.payload.to_bytes()


def _failure(key: str, payload: bytes) -> BusError:
    """What an error reply means."""
    if payload == b"Timeout":
        return PeerSilent(f"{key}: no answer in time")
    try:
        refusal = decode(payload, Refusal)
    except BadMessage:
        return PeerRefused(f"{key}: {payload[:300]!r}")
    return PeerRefused(f"{key}: {refusal.reason}", final=refusal.final)


@contextmanager
def open_router(
    endpoint: str, file: Path | None = None, *, shared_memory: bool = False
) -> Iterator[str]:
    """Be a Zenoh router while the block runs; yields the locator it listens on.

    endpoint: such as `tcp/127.0.0.1:7447`; port 0 takes a free one. file: configuration with
    certificates and allow-lists; None: open to everybody. Raises ConfigError if it cannot listen.
    """
    try:
        if file is None:
            config = zenoh_config("router", listen=[endpoint], shared_memory=shared_memory)
        else:
            config = zenoh.Config.from_json5(file.read_text())
            config.insert_json5("listen/endpoints", json.dumps([encrypted(endpoint)]))
        session = opened(config)
    except zenoh.ZError as error:
        reason = re.sub(r" at \S+\.rs:\d+\.?", "", str(error))
        raise ConfigError(f"router: cannot listen on {endpoint!r}: {reason}") from error
    try:
        yield locator(session, endpoint)
    finally:
        session.close()  # type: ignore[no-untyped-call]
