"""What comes from a robot's own network is bounded before it is kept; what is lost is counted."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from shared import foreign_bus
from shared.foreign_bus import MAX_ATTACHMENT, MAX_QUESTION, RawInbox


class Payload(bytes):
    """Bytes as Zenoh hands them over."""

    def to_bytes(self) -> bytes:  # type: ignore[override]
        return bytes(self)


def sample(size: int, attachment: int | None = None) -> Any:
    added = None if attachment is None else Payload(attachment)
    return SimpleNamespace(key_expr="scan", payload=Payload(size), attachment=added)


class Query:
    """A question that remembers what it was told."""

    def __init__(self, size: int) -> None:
        self.key_expr, self.payload, self.error = "question", Payload(size), ""

    def reply_err(self, text: bytes) -> None:
        self.error = text.decode()

    def drop(self) -> None:
        pass


def test_samples_larger_than_their_bound_are_refused_and_counted() -> None:
    inbox = RawInbox()
    for one in (sample(11), sample(1, MAX_ATTACHMENT + 1), sample(10, MAX_ATTACHMENT)):
        inbox.put_sample("scan", one, keep=4, max_bytes=10)
    kept = inbox.take("scan")
    assert kept is not None
    assert (len(kept.payload), len(kept.attachment)) == (10, MAX_ATTACHMENT)
    assert inbox.take("scan") is None
    assert inbox.refused == {"scan": 2}


@pytest.mark.parametrize(("keep", "lost"), [(1, 0), (2, 3)])
def test_a_full_place_keeps_the_newest_and_counts_what_was_not_meant_to_go(
    keep: int, lost: int
) -> None:
    inbox = RawInbox()
    for size in range(5):
        inbox.put_sample("scan", sample(size), keep=keep, max_bytes=10)
    found = [kept.payload for kept in iter(lambda: inbox.take("scan"), None)]
    assert [len(payload) for payload in found] == list(range(5))[-keep:]
    assert inbox.refused["scan"] == lost


def test_questions_beyond_their_bounds_are_answered_with_an_error() -> None:
    inbox = RawInbox()
    asked = [Query(MAX_QUESTION + 1), Query(MAX_QUESTION), Query(1)]
    for query in asked:
        inbox.put_query("questions", query, keep=1)  # type: ignore[arg-type]
    told = [query.error for query in asked]
    assert told == [f"expected at most {MAX_QUESTION} bytes", "", "busy"]
    assert inbox.refused == {"questions": 2}


def test_tokens_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(foreign_bus, "MAX_TOKENS", 2)
    inbox = RawInbox()
    for name in "abc":
        inbox.put_token(SimpleNamespace(key_expr=name, kind=None))  # type: ignore[arg-type]
    assert inbox.tokens() == {"a", "b"}
    assert inbox.refused == {"tokens": 1}
