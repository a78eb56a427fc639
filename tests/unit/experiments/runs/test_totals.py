"""What a run counts of its turns."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from builders import make_episode

from experiments.runs.totals import Totals


def turn(number: int, **given: Any) -> Any:
    """A turn about an episode of ten samples; number 0: while the memory is filled."""
    episode = make_episode(10, fill=number == 0, **given)
    return SimpleNamespace(submitted=episode, commit=SimpleNamespace(episode=number))


def test_the_longest_run_spans_episodes_ends_at_bumps_and_never_shrinks() -> None:
    totals = Totals()
    full: dict[str, Any] = {"ended": "full", "bump": False, "actions": 10, "fitness": 10}
    bump: dict[str, Any] = {"ended": "bump", "bump": True, "actions": 4, "fitness": 4}
    longer = [
        totals.count(turn(number, **given))
        for number, given in enumerate([full, full, full, bump, bump, full])
    ]
    assert longer == [False, True, True, True, False, False]
    assert totals.longest_run == 23
    assert totals.run_actions == 10


def test_episodes_of_one_action_are_counted_but_not_those_that_fill() -> None:
    totals = Totals()
    for number in range(3):
        totals.count(turn(number, ended="bump", bump=True, actions=1, fitness=1))
    assert totals.one_action_episodes == 2
