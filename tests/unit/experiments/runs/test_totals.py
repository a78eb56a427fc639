"""What a run counts of its turns, and what a row of its table tells of them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from builders import make_episode

from experiments.runs.episode_row import episode_row
from experiments.runs.totals import Totals
from services.replay.numbering import Counters
from shared.rl.memory import ReplayMemory
from shared.rl.retention.strategy import Discard
from shared.rl.turn import Maintenance


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


def test_a_row_tells_of_the_episode_and_of_all_so_far() -> None:
    trainer = SimpleNamespace(train_steps=8, fits=1, version=3, episode_at_copy=4)
    counters = Counters(actions=90, bumps=7, laps_left=2, laps_right=1)
    memory = ReplayMemory(50)
    loop: Any = SimpleNamespace(counters=counters, trainer=trainer, memory=memory)
    done = turn(6, ended="bump", bump=True, actions=4, fitness=5)
    done.commit.stored = 10
    done.trained, done.maintenance = [], Maintenance(Discard(50), equalised=False)
    row = episode_row(loop, done, "a", 1.234)
    assert [row[name] for name in ("episode", "actions", "bump", "fitness")] == [6, 4, 1, 5]
    assert [row[name] for name in ("total_actions", "bumps", "laps_left")] == [90, 7, 2]
    assert (row["target_age"], row["seconds"]) == (2, 1.23)
