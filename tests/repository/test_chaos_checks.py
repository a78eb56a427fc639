"""What the random events are judged by finds what must not happen, in made-up records."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from builders import make_config, make_episode, make_observation

from benchmarks.chaos_events import RELEASES, draw
from benchmarks.invariants import Checker, numbering_faults, sequence_faults
from services.replay.storage import Storage
from shared.messages import Action, ReplayState, RobotState

ROBOT, LIFE, OTHER = "robot1", "a" * 12, "b" * 12


def heartbeat(state: str, sequence: int, life: str = LIFE) -> RobotState:
    """A driver's heartbeat; only what is judged means something."""
    given: dict[str, Any] = {"robot": ROBOT, "life": life, "state": state, "sequence": sequence}
    return RobotState.model_construct(**given)


def halted(sequence: int = 7) -> Checker:
    """A robot that was seen to drive, and was then confirmed to stand after an emergency stop."""
    checker = Checker([ROBOT])
    checker.hear(make_observation(sequence - 1, life=LIFE))
    checker.hear(heartbeat("waiting", sequence - 1))
    checker.held("estop", [ROBOT])
    checker.hear(make_observation(sequence, life=LIFE))  # was under way
    checker.hear(heartbeat("estop", sequence))
    return checker


def test_a_robot_may_stand_under_a_halt_and_move_before_and_after() -> None:
    checker = halted()
    checker.hear(heartbeat("estop", 7))
    assert checker.shows_halt(LIFE)
    checker.released("estop", [ROBOT])
    checker.hear(make_observation(8, life=LIFE))
    checker.hear(heartbeat("driving", 9))
    assert checker.violations == []
    assert checker.actions == 3


def test_a_motion_under_a_halt_is_found() -> None:
    checker = halted()
    checker.hear(make_observation(8, life=LIFE))
    assert "moved under a halt" in checker.violations[0]


def test_a_driver_that_does_not_say_that_it_stands_is_found_when_it_drives_on() -> None:
    checker = Checker([ROBOT])
    checker.hear(make_observation(4, life=LIFE))
    checker.held("estop", [ROBOT])
    for sequence in (20, 21, 22):  # some were not heard, some are under way
        checker.hear(make_observation(sequence, life=LIFE))
    assert checker.violations == []
    checker.hear(make_observation(23, life=LIFE))
    assert len(checker.violations) == 1


def test_a_halt_that_a_robot_forgets_is_found() -> None:
    checker = halted()
    checker.hear(heartbeat("waiting", 7))
    assert "says waiting" in checker.violations[0]


def test_a_pause_that_ends_does_not_end_an_emergency_stop() -> None:
    checker = halted()
    checker.held("pause", [ROBOT])
    checker.released("pause", [ROBOT])
    checker.hear(make_observation(8, life=LIFE))
    assert len(checker.violations) == 1


@pytest.mark.parametrize(("sequence", "faults"), [(0, 0), (7, 0), (8, 1), (1, 1)])
def test_a_driver_that_starts_under_a_halt_begins_anew_or_where_one_left_off(
    sequence: int, faults: int
) -> None:
    checker = halted()
    checker.hear(heartbeat("estop", sequence, OTHER))
    assert len(checker.violations) == faults


def action(episode: int, fills: int) -> Action:
    given: dict[str, Any] = {
        "robot": ROBOT, "actor_life": LIFE, "episode": episode, "fills": fills,
    }  # fmt: skip
    return Action.model_construct(**given)


def replay_state(commit: int, refused: int = 0) -> ReplayState:
    return ReplayState.model_construct(commit=commit, refused=refused)


def records(folder: Path, *given: dict[str, Any]) -> list[Any]:
    """What replay keeps of submissions of twenty samples each."""
    storage = Storage(folder, make_config(memory={"capacity": 30}).memory, "test/1")
    for number, changes in enumerate(given):
        fill = changes.pop("fill", False)
        plain = {"number": number, "last_sequence": 20 * number + 19, "fill": fill}
        storage.commit(make_episode(20, seed=number, **{**plain, **changes}))
    found = [dict(record) for record in storage.records()]
    storage.close()
    return found


@pytest.fixture
def stored(tmp_path: Path) -> list[Any]:
    """Two submissions of the fill, and two episodes."""
    return records(tmp_path, {"fill": True}, {"fill": True}, {}, {})


def test_what_replay_really_stores_has_no_faults(stored: list[Any]) -> None:
    checker = Checker([ROBOT])
    for message in (action(0, 2), action(1, 2), replay_state(3), replay_state(4), action(2, 2)):
        checker.hear(message)
    checker.stored(stored)
    assert checker.violations == []


def test_a_doubled_episode_is_found(stored: list[Any]) -> None:
    doubled = [*stored, stored[-1]]
    assert any("doubled" in fault for fault in numbering_faults(doubled))
    assert any("doubled" in fault for fault in sequence_faults(doubled, {}))


def test_an_episode_that_is_missing_is_found(stored: list[Any]) -> None:
    assert any("lost" in fault for fault in numbering_faults([*stored[:2], stored[3]]))


def test_a_changed_history_is_found(stored: list[Any]) -> None:
    stored[1]["digest"] = "0" * 16
    assert any("lineage" in fault for fault in numbering_faults(stored))


def test_actions_that_a_continued_life_tells_again_are_found(tmp_path: Path) -> None:
    stored = records(
        tmp_path, {"fill": True}, {"fill": True, "robot_life": "c" * 12, "last_sequence": 24}
    )
    assert sequence_faults(stored, {}) == []
    life = stored[0]["robot_life"]
    assert len(sequence_faults(stored, {life: life, "c" * 12: life})) == 1


@pytest.mark.parametrize("told", [action(3, 2), action(2, 3), replay_state(5)])
def test_an_acknowledged_episode_that_is_not_stored_is_found(stored: list[Any], told: Any) -> None:
    checker = Checker([ROBOT])
    checker.hear(told)
    assert checker.violations == []
    checker.stored(stored)
    assert len(checker.violations) == 1


@pytest.mark.parametrize(
    ("first", "then"), [(action(2, 0), action(1, 0)), (replay_state(4), replay_state(3))]
)
def test_what_is_told_never_becomes_less(first: Any, then: Any) -> None:
    checker = Checker([ROBOT])
    checker.hear(first)
    checker.hear(then)
    assert len(checker.violations) == 1


def test_an_episode_refused_for_good_is_found() -> None:
    checker = Checker([ROBOT])
    checker.hear(replay_state(4, refused=1))
    assert len(checker.violations) == 1


def test_a_seed_always_draws_the_same_events() -> None:
    plan = draw(7, 300)
    assert draw(7, 300) == plan
    assert draw(8, 300) != plan
    assert {event.kind for event in plan} >= {"kill all", "router", *RELEASES, *RELEASES.values()}
    held: set[str] = set()
    for event in plan:  # a halt is released before the next of its kind
        if event.kind in RELEASES:
            assert event.kind not in held
            held.add(event.kind)
        held -= {kind for kind, name in RELEASES.items() if name == event.kind}
