"""A line for each kind and minute, and no line is lost without being counted."""

from __future__ import annotations

from shared.complaints import PERIOD_S, Complaints


def test_one_line_for_each_kind_and_minute_tells_of_those_before_it() -> None:
    lines: list[str] = []
    now = [0.0]
    complaints = Complaints(lines.append, lambda: now[0])
    for number in range(5):
        complaints.tell("size", f"too large {number}")
        complaints.tell("type", f"wrong type {number}")
        now[0] += PERIOD_S / 5
    assert lines == ["too large 0", "wrong type 0"]
    complaints.tell("size", "too large again")
    assert lines[2:] == ["too large again (4 more like this before)"]
    now[0] += PERIOD_S
    complaints.tell("size", "and again")
    assert lines[3:] == ["and again"]
