"""Zenoh sessions with others than our services: raw keys and bytes, such as a robot's ROS 2.

The rules are those of `bus.py`: callbacks only put bytes into bounded places of an inbox, the one
thread that owns the inbox decodes and acts, and what is not taken is counted.
"""

import re
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import zenoh

from shared.errors import ConfigError, RouterMissing
from shared.inbox import Arrivals
from shared.zenoh_settings import locator, zenoh_config

MAX_TOKENS = 4096
"""Liveliness tokens an inbox remembers; more are refused and counted."""
MAX_ATTACHMENT = 1024
"""Bytes of an attachment; a sample with a larger one is refused."""
MAX_QUESTION = 64 * 1024
"""Bytes of a question's payload; larger ones are refused."""


@dataclass(frozen=True)
class RawSample:
    """One sample as it came."""

    key: str
    payload: bytes
    attachment: bytes
    """Empty when there was none."""
    arrived_s: float
    """Monotonic clock of this computer."""


class Question:
    """One query, waiting for its one answer."""

    def __init__(self, query: zenoh.Query, payload: bytes) -> None:
        self.key, self.payload, self._query = str(query.key_expr), payload, query

    def answer(self, payload: bytes) -> None:
        """Answer and finish."""
        self._query.reply(self._query.key_expr, payload)
        self._query.drop()  # type: ignore[no-untyped-call]

    def refuse(self, reason: str) -> None:
        """Answer with an error in one line, and finish."""
        self._query.reply_err(reason.encode())
        self._query.drop()  # type: ignore[no-untyped-call]


class RawInbox(Arrivals):
    """Where raw samples, questions and liveliness for one thread arrive."""

    def __init__(self) -> None:
        super().__init__()
        self._samples: dict[str, deque[RawSample]] = {}
        self._questions: deque[Question] = deque()
        self._tokens: set[str] = set()
        self.changes = 0
        """Changes of the set of tokens so far."""
        self.refused: Counter[str] = Counter()
        """What was not taken, by name of the place: too large, or the place was full."""

    def take(self, name: str) -> RawSample | None:
        """The oldest sample kept in a place and not taken yet."""
        with self._ready:
            kept = self._samples.get(name)
            return kept.popleft() if kept else None

    def question(self) -> Question | None:
        """The oldest question not taken yet."""
        with self._ready:
            return self._questions.popleft() if self._questions else None

    def tokens(self) -> frozenset[str]:
        """Keys of all liveliness tokens there are now."""
        with self._ready:
            return frozenset(self._tokens)

    def put_sample(self, name: str, sample: zenoh.Sample, keep: int, max_bytes: int) -> None:
        """Keep a sample; of a full place the oldest goes: by design with one, else counted."""
        attachment = sample.attachment
        large = len(sample.payload) > max_bytes
        if large or (attachment is not None and len(attachment) > MAX_ATTACHMENT):
            with self._ready:
                self.refused[name] += 1
            return
        raw = RawSample(
            str(sample.key_expr),
            sample.payload.to_bytes(),
            attachment.to_bytes() if attachment is not None else b"",
            time.monotonic(),
        )
        with self._ready:
            kept = self._samples.setdefault(name, deque())
            if len(kept) >= keep:
                kept.popleft()
                self.refused[name] += int(keep > 1)
            kept.append(raw)
            self._arrive()

    def put_query(self, name: str, query: zenoh.Query, keep: int) -> None:
        """Keep a question; when full, refuse it at once."""
        payload = query.payload
        if payload is not None and len(payload) > MAX_QUESTION:
            problem = f"expected at most {MAX_QUESTION} bytes"
        else:
            with self._ready:
                if len(self._questions) < keep:
                    data = payload.to_bytes() if payload is not None else b""
                    self._questions.append(Question(query, data))
                    self._arrive()
                    return
            problem = "busy"
        with self._ready:
            self.refused[name] += 1
        query.reply_err(problem.encode())
        query.drop()  # type: ignore[no-untyped-call]

    def put_token(self, sample: zenoh.Sample) -> None:
        """Remember a token that appeared, forget one that went."""
        key = str(sample.key_expr)
        with self._ready:
            if sample.kind == zenoh.SampleKind.DELETE:
                self._tokens.discard(key)
            elif len(self._tokens) < MAX_TOKENS:
                self._tokens.add(key)
            else:
                self.refused["tokens"] += 1
            self.changes += 1
            self._arrive()


class RawPublisher:
    """Publishes to one key; never blocks, what the network cannot take at once is lost."""

    def __init__(self, publisher: zenoh.Publisher) -> None:
        self._publisher = publisher

    @property
    def matching(self) -> bool:
        """Whether anybody subscribes to the key now."""
        status: Any = self._publisher.matching_status  # an object that is true whatever it says
        return bool(status.matching)

    def put(self, payload: bytes, attachment: bytes = b"") -> None:
        """Publish one sample. Raises RouterMissing when the session is closed."""
        try:
            self._publisher.put(payload, attachment=attachment or None)
        except zenoh.ZError as error:
            raise RouterMissing(f"cannot publish: {error}") from error


Undeclare = Callable[[], None]


class ForeignBus:
    """One session with a foreign network. Close it: an unclosed session never exits.

    A client connects to `endpoint`, again whenever the router comes back; raises RouterMissing when
    none answers within about a second. A router listens there; raises ConfigError when it cannot.
    """

    def __init__(self, endpoint: str, mode: Literal["client", "router"] = "client") -> None:
        client = mode == "client"
        try:
            config = zenoh_config(
                mode, connect=[endpoint] if client else [], listen=[] if client else [endpoint]
            )
        except zenoh.ZError as error:
            raise ConfigError(
                f"{endpoint!r} is no Zenoh endpoint: expected one such as tcp/127.0.0.1:7447"
            ) from error
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            reason = re.sub(r" at \S+\.rs:\d+\.?", "", str(error))
            if client:
                raise RouterMissing(f"no Zenoh router at {endpoint}: {reason}") from error
            raise ConfigError(f"cannot listen on {endpoint!r}: {reason}") from error
        self.endpoint = endpoint if client else locator(self._session, endpoint)
        """Where it is connected to, or really listens."""
        self.zid = str(self._session.zid())
        self._declared: list[Any] = []

    def subscribe(
        self, inbox: RawInbox, name: str, key: str, *, max_bytes: int, keep: int = 1
    ) -> Undeclare:
        """Keep the newest `keep` samples of a key under a name; returns what ends that."""

        def on_sample(sample: zenoh.Sample) -> None:
            inbox.put_sample(name, sample, keep, max_bytes)

        direct = zenoh.handlers.Callback(on_sample, indirect=False)
        return self._kept(self._session.declare_subscriber(key, direct))

    def watch(self, inbox: RawInbox, key: str) -> Undeclare:
        """Remember the liveliness tokens of a key, those already there included."""
        direct = zenoh.handlers.Callback(inbox.put_token, indirect=False)
        return self._kept(self._session.liveliness().declare_subscriber(key, direct, history=True))

    def serve(self, inbox: RawInbox, name: str, key: str, *, keep: int = 16) -> Undeclare:
        """Queue at most `keep` questions."""

        def on_query(query: zenoh.Query) -> None:
            inbox.put_query(name, query, keep)

        return self._kept(self._session.declare_queryable(key, on_query))

    def publisher(self, key: str) -> RawPublisher:
        """A publisher that lives as long as the session."""
        return RawPublisher(
            self._session.declare_publisher(
                key, express=True, congestion_control=zenoh.CongestionControl.DROP
            )
        )

    def token(self, key: str) -> Undeclare:
        """Declare a liveliness token; returns what ends it."""
        return self._kept(self._session.liveliness().declare_token(key))

    def ask(self, key: str, payload: bytes = b"", timeout_s: float = 5.0) -> bytes | None:
        """The first answer to a question; None without one. Raises ConfigError when refused."""
        for reply in self._session.get(key, payload=payload, timeout=timeout_s):
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
            text = reply.err.payload.to_string() if reply.err else "unknown error"
            if text != "Timeout":
                raise ConfigError(f"{key}: {text}")
        return None

    def close(self) -> None:
        """Undeclare everything and leave; may be called twice."""
        self._session.close()  # type: ignore[no-untyped-call]

    def _kept(self, declared: Any) -> Undeclare:
        """Keep a declaration alive until it is undeclared."""
        self._declared.append(declared)

        def undeclare() -> None:
            if declared in self._declared:
                self._declared.remove(declared)
                declared.undeclare()

        return undeclare
