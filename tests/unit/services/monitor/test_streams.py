"""What is shown of streams, without a bus and in simulated time."""

from __future__ import annotations

import pytest
from builders import make_observation

from services.cli import main as cli
from services.monitor.streams import KEPT, PUBLISHED, Gauge
from shared.codec import encode
from shared.inbox import MAX_SENDERS


def test_rate_size_age_and_content_are_told() -> None:
    now_s = 100.0
    gauge = Gauge(["observation", "action"], clock=lambda: now_s)
    data = encode(make_observation(7))
    for now_s in (100.0, 101.0, 102.0):  # noqa: B007 - read by the clock
        gauge.note("observation", "robot1", data)
    now_s = 104.0
    heard, silent = gauge.rows()
    assert heard[:5] == ("observation", "robot1", "0.5 Hz", f"{len(data)} bytes", "2.0 s ago")
    assert '"sequence": 7' in heard[5]
    assert '"image": "3750 bytes"' in heard[5]
    assert silent == ("action", "-", "not heard")


def test_every_message_is_told_once_and_what_came_too_fast_is_counted() -> None:
    gauge = Gauge(["observation"])
    for number in range(KEPT + 3):
        gauge.note("observation", "robot1", encode(make_observation(number)))
    gauge.note("observation", None, b"")
    lines = list(gauge.news())
    assert len(lines) == KEPT + 2
    assert '"sequence": 3,' in lines[0]
    assert "robot1: 3 came too fast to be shown" in lines
    assert "no message" in lines[-1]
    assert list(gauge.news()) == []


def test_texts_of_others_cannot_write_to_the_terminal_and_senders_are_bounded() -> None:
    gauge = Gauge(PUBLISHED)
    for number in range(MAX_SENDERS + 2):
        gauge.note("action", f"r{number}", b"\x1b[2J")
    lines = [" ".join(row) for row in gauge.rows()]
    assert all(line.isprintable() for line in lines)
    assert "of more senders - 2 messages" in lines


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("echo", "observatoin"), "did you mean observation?"),
        (("hz",), "stream: expected one of"),
        (("hz", "weights"), "weights: cannot be watched"),
        (("hzz", "action"), "did you mean hz?"),
    ],
)
def test_what_cannot_be_watched_is_named(
    words: tuple[str, ...], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["streams", *words, "--endpoint", "tcp/127.0.0.1:1"]) == 2
    assert told in capsys.readouterr().err
