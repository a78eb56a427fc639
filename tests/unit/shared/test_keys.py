"""The table of streams: complete, typed, without overlap, and safe against widening names."""

from __future__ import annotations

import itertools

import pytest
import zenoh

from shared import messages as m
from shared.keys import ACTION, OBSERVATION, STREAMS, Peer, Stream, alive_key, parse_alive

NAMES = [stream.name for stream in STREAMS]


@pytest.mark.parametrize("stream", STREAMS, ids=NAMES)
def test_every_stream_is_typed_and_bounded(stream: Stream) -> None:
    assert issubclass(stream.request, m.Message)
    assert all(issubclass(reply, m.Message) for reply in stream.reply)
    assert bool(stream.reply) == (stream.delivery == "request")
    assert 0 < stream.max_bytes <= 32 * 1024 * 1024
    assert (stream.queue == 1) if stream.delivery == "latest" else (stream.queue > 1)
    assert all((stream.senders, stream.receivers, stream.rate))
    assert stream.pattern.startswith("{run}/")


def test_names_and_patterns_are_unique() -> None:
    assert len(set(NAMES)) == len(STREAMS)
    assert len({stream.pattern for stream in STREAMS}) == len(STREAMS)


def test_no_two_streams_share_a_key() -> None:
    for one, other in itertools.combinations(STREAMS, 2):
        first, second = zenoh.KeyExpr(one.wildcard("run1")), zenoh.KeyExpr(other.wildcard("run1"))
        assert not first.intersects(second), (one.name, other.name)


@pytest.mark.parametrize("stream", STREAMS, ids=NAMES)
def test_two_runs_and_the_liveliness_tokens_never_mix(stream: Stream) -> None:
    key = zenoh.KeyExpr(stream.wildcard("run1"))
    assert not key.intersects(zenoh.KeyExpr(stream.wildcard("run2")))
    assert not key.intersects(zenoh.KeyExpr("run1/alive/**"))


@pytest.mark.parametrize("stream", STREAMS, ids=NAMES)
def test_a_concrete_key_is_matched_by_its_wildcard(stream: Stream) -> None:
    key = stream.key("run1", "some-one_1")
    assert zenoh.KeyExpr(stream.wildcard("run1")).includes(zenoh.KeyExpr(key))
    assert not set(key) & set("*${}#?")


def test_keys_are_what_other_languages_were_told() -> None:
    assert OBSERVATION.key("demo", "robot1") == "demo/robot/robot1/observation"
    assert OBSERVATION.wildcard("demo") == "demo/robot/*/observation"
    assert ACTION.key("demo", "robot1") == "demo/actor/robot1/action"


@pytest.mark.parametrize(
    "name",
    ["", "*", "**", "$*", "a*", "a/b", "/", "a/", "A", "a b", "ä", "-a", "_a", "a" * 42, "a#"],
)
def test_names_that_could_widen_a_key_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match="expected a name"):
        OBSERVATION.key("run1", name)
    with pytest.raises(ValueError, match="expected a name"):
        OBSERVATION.key(name, "robot1")


def test_a_stream_without_instances_asks_for_no_name() -> None:
    single = [stream for stream in STREAMS if "{id}" not in stream.pattern]
    assert single
    for stream in single:
        assert stream.key("run1") == stream.wildcard("run1")


def test_liveliness_tokens_tell_who_lives() -> None:
    key = alive_key("run1", "actor", "main", "0" * 12, 1, "f" * 16)
    assert parse_alive(key) == Peer("actor", "main", "0" * 12, "1", "f" * 16)


@pytest.mark.parametrize(
    "key",
    [
        "", "run1/alive", "run1/alive/a/b/c/d", "run1/alive/a/b/c/d/e/f", "run1/dead/a/b/c/d/e",
        "run1/alive/actor/\x1b[31m/b/1/d", "run1/alive/actor/[red]/b/1/d",
        f"run1/alive/actor/{'x' * 65}/b/1/d",
    ],
)  # fmt: skip
def test_other_keys_are_no_liveliness_tokens(key: str) -> None:
    assert parse_alive(key) is None


def test_name_with_a_trailing_line_break_is_refused() -> None:
    with pytest.raises(ValueError, match="expected a name"):
        OBSERVATION.key("run", "robot1\n")
