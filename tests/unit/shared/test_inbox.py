"""Sizes and numbers of messages are bounded before they are read; what does not fit is counted."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from builders import make_observation

from shared.bus import Bus
from shared.codec import encode
from shared.inbox import MAX_SENDERS, Inbox
from shared.keys import OBSERVATION, PROGRESS
from shared.messages import Observation


class Wire:
    """A bus that hands over what the test puts in."""

    receive: Callable[..., None]

    def subscribe(self, stream: Any, ident: str, receive: Callable[..., None]) -> None:
        self.receive = receive

    serve = subscribe


class Payload(bytes):
    """Bytes as Zenoh hands them over."""

    def to_bytes(self) -> bytes:
        return bytes(self)


class Question:
    """A request of so many bytes."""

    def __init__(self, size: int) -> None:
        self.size, self.refused, self.final = size, "", False

    def __enter__(self) -> Question:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def refuse(self, reason: str, *, final: bool = False) -> None:
        self.refused, self.final = reason, final


def test_requests_beyond_the_queue_are_answered_busy() -> None:
    wire: Any = Wire()
    inbox = Inbox(wire)
    inbox.serve(PROGRESS)
    asked = [Question(1) for _ in range(PROGRESS.queue + 2)]
    for question in asked:
        wire.receive(question)
    assert [question.refused for question in asked] == [""] * PROGRESS.queue + ["busy"] * 2
    assert not any(question.final for question in asked)
    assert (inbox.refused, inbox.busy) == ({}, {PROGRESS.name: 2})


def test_requests_that_are_empty_or_too_large_are_refused_unread() -> None:
    wire: Any = Wire()
    inbox = Inbox(wire)
    inbox.serve(PROGRESS)
    for size in (0, PROGRESS.max_bytes + 1):
        question = Question(size)
        wire.receive(question)
        assert question.refused == f"expected 1..{PROGRESS.max_bytes} bytes of payload"
        assert question.final
    assert inbox.refused == {PROGRESS.name: 2}


def test_senders_are_bounded_and_a_newer_message_takes_the_place_of_an_older() -> None:
    wire: Any = Wire()
    inbox = Inbox(wire)
    inbox.subscribe(OBSERVATION)
    for _ in range(2):
        for number in range(MAX_SENDERS + 1):
            wire.receive(f"robot{number}", b"")
    wire.receive(None, b"")
    assert inbox.refused.total() + inbox.busy.total() == 3
    assert len(inbox._latest) == MAX_SENDERS


def test_a_message_of_another_robot_than_its_key_tells_is_refused() -> None:
    wire: Any = Wire()
    inbox = Inbox(wire)
    inbox.subscribe(OBSERVATION)
    wire.receive("robot1", encode(make_observation(0, robot="robot1")))
    wire.receive("robot2", encode(make_observation(0, robot="robot1")))
    assert [sender for sender, _ in inbox.take(OBSERVATION, Observation)] == ["robot1"]
    assert inbox.refused == {OBSERVATION.name: 1}


def test_publications_are_refused_by_size_and_key_before_they_are_read() -> None:
    bus: Any = object.__new__(Bus)
    declared: list[Any] = []
    declare = lambda key, handler: declared.append((key, handler))  # noqa: E731
    bus.run, bus._declared = "demo", []
    bus._session = SimpleNamespace(declare_subscriber=declare)
    heard: list[tuple[str | None, bytes]] = []
    bus.subscribe(OBSERVATION, "*", lambda *told: heard.append(told))
    (key, handler) = declared[0]
    for name, size in (
        ("robot1", OBSERVATION.max_bytes), ("robot1", OBSERVATION.max_bytes + 1), ("*", 1),
    ):  # fmt: skip
        handler(SimpleNamespace(key_expr=key.replace("*", name), payload=Payload(size)))
    assert heard == [("robot1", bytes(OBSERVATION.max_bytes)), (None, b""), (None, b"")]
