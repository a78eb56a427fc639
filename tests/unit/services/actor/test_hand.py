"""Who drives a robot that a person may take over, and for how long a wish holds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.actor.hand import HOLDER_SILENT_S, WISH_S, Hand
from shared.messages import Takeover

ONE, OTHER = "1" * 12, "2" * 12


def said(number: int, action: int | None = 1, life: str = ONE, **given: Any) -> Takeover:
    return Takeover(robot="robot1", life=life, number=number, action=action, **given)


def test_a_wish_holds_for_a_moment_and_the_takeover_until_it_is_given_back(tmp_path: Path) -> None:
    hand = Hand(tmp_path / "robot1.taken")
    assert not hand.taken
    hand.note(said(1, 2), 10.0)
    assert (hand.taken, hand.wish(10.0), hand.wish(10.0 + WISH_S)) == (True, 2, None)
    hand.note(said(2, None), 10.1)
    assert hand.wish(10.1) is None
    hand.note(said(1, 0), 10.2)  # it comes late
    assert (hand.wish(10.2), hand.refused) == (None, 1)
    assert hand.taken
    assert hand.silent_s(1000.0) > HOLDER_SILENT_S
    hand.note(said(3, 0, give_back=True), 1000.0)
    assert (hand.taken, hand.wish(1000.0)) == (False, None)


def test_one_person_drives_at_a_time(tmp_path: Path) -> None:
    hand = Hand(tmp_path / "robot1.taken")
    hand.note(said(7, 1), 0.0)
    for other in (said(8, 0, OTHER), said(9, None, OTHER, give_back=True)):
        hand.note(other, HOLDER_SILENT_S - 0.1)
        assert (hand.taken, hand.life) == (True, ONE)
    assert hand.refused == 2
    hand.note(said(1, 0, OTHER), HOLDER_SILENT_S)  # the first one is gone
    assert (hand.life, hand.wish(HOLDER_SILENT_S)) == (OTHER, 0)


def test_a_restarted_actor_lets_no_network_drive_a_robot_that_was_taken_over(
    tmp_path: Path,
) -> None:
    path = tmp_path / "actor" / "robot1.taken"
    Hand(path).note(said(1), 0.0)
    after = Hand(path)
    assert (after.taken, after.wish(0.0)) == (True, None)
    after.note(said(1, None, OTHER, give_back=True), 0.0)
    assert not after.taken
    assert not Hand(path).taken


def test_a_full_disk_keeps_nobody_from_taking_over(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    hand = Hand(tmp_path / "file" / "robot1.taken")  # there can be no such file
    with pytest.raises(OSError, match="file"):
        hand.note(said(1, 2), 0.0)
    assert (hand.taken, hand.wish(0.1)) == (True, 2)
    hand.note(said(2, None), 0.2)  # it is told of once
    assert hand.taken


MESSAGES = st.lists(
    st.tuples(
        st.floats(0.0, 2.0),
        st.sampled_from([ONE, OTHER]),
        st.integers(0, 5),
        st.sampled_from([None, 0, 1, 2]),
        st.booleans(),
    ),
    max_size=20,
)


@settings(deadline=None, max_examples=60, derandomize=True)
@given(MESSAGES, st.floats(0.0, 2.0))
def test_no_robot_moves_without_a_fresh_wish_of_who_drives_it(
    tmp_path_factory: Any, messages: list[tuple[float, str, int, int | None, bool]], later_s: float
) -> None:
    hand, now_s = Hand(tmp_path_factory.mktemp("hand") / "taken"), 0.0
    for gap_s, life, number, action, give_back in messages:
        now_s += gap_s
        before = hand.life, hand.taken
        hand.note(said(number, action, life, give_back=give_back), now_s)
        if hand.wish(now_s) is not None and (life, True) != before:
            assert hand.life in (life, before[0])
    wished = hand.wish(now_s + later_s)
    if wished is not None:
        assert hand.taken
        recent = []
        at_s = now_s
        for gap_s, life, _, action, _ in reversed(messages):
            recent.append((at_s, life, action))
            at_s -= gap_s
        fresh = [r for r in recent if now_s + later_s - r[0] < WISH_S]
        assert (hand.life, wished) in [(life, action) for _, life, action in fresh]
