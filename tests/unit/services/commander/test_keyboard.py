"""Keys of a terminal, and what is wanted after them: a deadman above all."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.commander.keyboard import DEADMAN_S, MOTIONS, KeyParser, Wish

FAST = settings(deadline=None, max_examples=200, derandomize=True)
KEYS = st.sampled_from([*MOTIONS, " ", "e", "q", "x", "escape", "W", "\n"])
GAPS = st.floats(0.0, 1.0)


@pytest.mark.parametrize(
    ("data", "keys"),
    [
        (b"wa", ["w", "a"]),
        (b"\x1b[A\x1b[B\x1b[C\x1b[D", ["up", "down", "right", "left"]),
        (b"\x1bOA\x1bOD", ["up", "left"]),
        (b"\x1b[3~", ["escape"]),
        (b"\x1b[1;5D", ["escape"]),
        (b"\x1b\x1bq", ["escape", "escape", "q"]),
        (b"\x1b", []),
        (b"\xff", ["\xff"]),
    ],
)
def test_keys_are_cut_from_bytes(data: bytes, keys: list[str]) -> None:
    assert KeyParser().feed(data) == keys


@FAST
@given(st.binary(max_size=40), st.integers(0, 40))
def test_it_does_not_matter_how_bytes_are_cut(data: bytes, cut: int) -> None:
    parser = KeyParser()
    assert parser.feed(data[:cut]) + parser.feed(data[cut:]) == KeyParser().feed(data)


@FAST
@given(st.lists(st.tuples(KEYS, GAPS), max_size=30), GAPS)
def test_a_motion_is_wanted_only_shortly_after_its_key(
    presses: list[tuple[str, float]], later_s: float
) -> None:
    wish, now_s, last = Wish(MOTIONS, ""), 100.0, ("", -1.0)
    for key, gap_s in presses:
        now_s += gap_s
        wish.press(key, now_s)
        last = (key, now_s)
    now_s += later_s
    wanted = wish.now(now_s)
    if now_s - last[1] >= DEADMAN_S or last[0].lower() not in MOTIONS:
        assert wanted == ""
    else:
        assert wanted == MOTIONS[last[0].lower()]
    assert wish.now(now_s + DEADMAN_S) == ""


@FAST
@given(st.lists(KEYS, max_size=20))
def test_an_emergency_stop_is_never_forgotten(keys: list[str]) -> None:
    wish = Wish(MOTIONS, "")
    for i, key in enumerate(keys):
        wish.press(key, float(i))
    expected = "estop" if "e" in keys else "quit" if "q" in keys else ""
    assert wish.take_command() == expected
    assert wish.take_command() == ""
