"""The numbers replay hands out (A13, E9, E10, E25), against counting by hand."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import msgpack
import pytest
from builders import LIFE, OTHER_LIFE, make_episode
from hypothesis import given, settings
from hypothesis import strategies as st

from services.replay.numbering import Counters, accept, filling, progress_of, refill, refusal
from shared.config import MemoryConfig
from shared.errors import StateError
from shared.rl.turn import Commit

FAST = settings(deadline=None, max_examples=60, derandomize=True)
CONFIG = MemoryConfig(capacity=30)
NO_FILL = MemoryConfig(capacity=30, fill="none")


def after(config: MemoryConfig, *episodes: Any) -> tuple[list[Commit], Counters]:
    counters, commits = Counters(), []
    for episode in episodes:
        commit, counters = accept(counters, config, episode)
        commits.append(commit)
    return commits, counters


def test_the_memory_is_filled_with_exactly_its_capacity_and_the_rest_is_counted() -> None:
    fills = [make_episode(n, fill=True) for n in (12, 12, 12, 4)]
    commits, counters = after(CONFIG, *fills)
    assert [c.stored for c in commits] == [12, 12, 6, 0]
    assert [c.first_id for c in commits] == [1, 13, 25, 31]
    assert [c.episode for c in commits] == [0, 0, 0, 0]
    assert (counters.filled, counters.fill_surplus, counters.next_id) == (30, 10, 31)
    assert (counters.episode, counters.actions, counters.bumps) == (0, 0, 0)


def test_filling_ends_at_the_last_missing_sample() -> None:
    counters = Counters()
    _, counters = accept(counters, CONFIG, make_episode(29, fill=True))
    assert filling(counters, CONFIG)
    assert progress_of(counters, CONFIG, "robot1").fill_missing == 1
    _, counters = accept(counters, CONFIG, make_episode(1, fill=True))
    assert not filling(counters, CONFIG)
    assert progress_of(counters, CONFIG, "robot1").fill_missing == 0


def test_a_memory_that_is_not_to_be_filled_takes_episodes_at_once() -> None:
    assert not filling(Counters(), NO_FILL)
    assert refusal(Counters(), NO_FILL, make_episode(3)) == ""
    (commit,), counters = after(NO_FILL, make_episode(3))
    assert (commit.episode, commit.stored, counters.episode) == (1, 3, 1)


def test_an_episode_before_the_memory_is_full_is_refused_with_what_is_missing() -> None:
    _, counters = after(CONFIG, make_episode(10, fill=True))
    assert "20 samples missing" in refusal(counters, CONFIG, make_episode(3))
    assert refusal(counters, CONFIG, make_episode(3, fill=True)) == ""
    _, counters = after(CONFIG, make_episode(30, fill=True))
    assert refusal(counters, CONFIG, make_episode(3)) == ""


def test_robots_share_the_global_number_and_keep_their_own() -> None:
    one, two = {"robot": "robot1"}, {"robot": "robot2"}
    commits, counters = after(
        NO_FILL, make_episode(2, **one), make_episode(3, **two), make_episode(4, **one)
    )
    assert [(c.commit, c.episode, c.first_id) for c in commits] == [(1, 1, 1), (2, 2, 3), (3, 3, 6)]
    first = progress_of(counters, NO_FILL, "robot1")
    second = progress_of(counters, NO_FILL, "robot2")
    unknown = progress_of(counters, NO_FILL, "robot3")
    assert (first.robot_episodes, second.robot_episodes, unknown.robot_episodes) == (2, 1, 0)
    assert (first.episode, unknown.episode) == (3, 3)
    assert (unknown.robot_life, unknown.last_sequence) == ("", -1)


def test_progress_names_the_newest_driver_life_and_sequence() -> None:
    _, counters = after(
        NO_FILL,
        make_episode(2, robot_life=LIFE, last_sequence=90),
        make_episode(2, robot_life=OTHER_LIFE, last_sequence=4),
    )
    found = progress_of(counters, NO_FILL, "robot1")
    assert (found.robot_life, found.last_sequence) == (OTHER_LIFE, 4)


episodes = st.lists(
    st.tuples(
        st.integers(1, 20),
        st.sampled_from(["bump", "full", "interrupted"]),
        st.integers(0, 40),
        st.integers(0, 3),
        st.booleans(),
    ),
    max_size=25,
)


@FAST
@given(episodes)
def test_totals_and_longest_run_equal_counting_action_by_action(
    given_episodes: list[tuple[int, str, int, int, bool]],
) -> None:
    """E10, E43: a run counts actions without a bump, across episodes, without the bumping one."""
    made = []
    for n, ended, actions, odd, fill in given_episodes:
        actions += int(ended == "bump")
        made.append(
            make_episode(
                n,
                robot=f"robot{n % 2}",
                fill=fill,
                ended=ended,
                actions=actions,
                fitness=max(actions - 7, int(ended == "bump")) if odd == 3 else actions + n,
                dropped_samples=odd,
                laps_left=odd,
                laps_right=2 * odd,
                dropped_episodes=int(odd == 3),
            )
        )
    _, counters = after(NO_FILL, *made)
    run, longest = {"robot0": 0, "robot1": 0}, {"robot0": 0, "robot1": 0}
    for episode in made:
        if episode.dropped_episodes:  # interrupted before it began
            run[episode.robot] = 0
        driven = episode.fitness if episode.dropped_episodes else episode.actions
        for number in range(0 if episode.fill else driven):
            run[episode.robot] += int(not (episode.bump and number == driven - 1))
            longest[episode.robot] = max(longest[episode.robot], run[episode.robot])
        if episode.ended != "full":
            run[episode.robot] = 0
    for name, robot in counters.robots.items():
        assert (robot.run_actions, robot.longest_run_actions) == (run[name], longest[name])
    assert counters.longest_run_actions == max(longest.values())
    counted = [e for e in made if not e.fill]
    assert counters.episode == len(counted)
    assert counters.bumps == sum(e.bump for e in counted)
    assert counters.actions == sum(e.actions for e in counted)
    assert counters.next_id == 1 + sum(e.count for e in counted)
    assert counters.laps_right == 2 * counters.laps_left == 2 * sum(e.laps_left for e in counted)
    assert counters.dropped_samples == sum(e.dropped_samples for e in made)
    assert counters.dropped_episodes == sum(e.dropped_episodes for e in made)


def test_a_run_goes_on_across_full_episodes_and_counts_before_it_ends() -> None:
    _, counters = after(NO_FILL, *[make_episode(40, ended="full", seed=i) for i in range(3)])
    assert counters.longest_run_actions == counters.robots["robot1"].run_actions == 120


@pytest.mark.parametrize(
    ("between", "longest"),
    [
        ({"ended": "bump", "fill": True}, 40),
        ({"ended": "interrupted", "fill": True}, 40),
        ({"ended": "full", "fill": True}, 80),
        ({"ended": "interrupted", "actions": 9}, 49),
        ({"ended": "full", "robot": "robot2", "actions": 9}, 80),
        ({"ended": "bump", "robot": "robot2", "actions": 9}, 80),
        ({"ended": "full", "dropped_episodes": 1, "actions": 9, "fitness": 5}, 45),
    ],
)
def test_what_comes_between_two_stretches_ends_the_run_or_does_not(
    between: dict[str, Any], longest: int
) -> None:
    """E43: per robot; a bump or an interruption ends it at any time, while filling too."""
    stretch = {"ended": "full", "actions": 40}
    _, counters = after(
        NO_FILL, make_episode(9, **stretch), make_episode(9, **between), make_episode(9, **stretch)
    )
    assert counters.longest_run_actions == longest


def test_a_larger_memory_is_filled_to_exactly_its_capacity() -> None:
    """E44: what is held as a second fill begins counts, not what was stored to fill once."""
    _, counters = after(CONFIG, make_episode(30, fill=True), make_episode(5))
    larger = MemoryConfig(capacity=60)
    counters = refill(counters, larger, held=29)
    assert progress_of(counters, larger, "robot1").fill_missing == 31
    assert refill(counters, larger, held=29) == counters  # also when it goes on
    commit, counters = accept(counters, larger, make_episode(40, fill=True))
    assert (commit.stored, filling(counters, larger)) == (31, False)
    assert refill(counters, larger, held=59) == counters  # a discard is no reason to fill again


@FAST
@given(episodes)
def test_counters_survive_the_way_to_disk(
    given_episodes: list[tuple[int, str, int, int, bool]],
) -> None:
    made = [
        make_episode(n, ended=ended, robot=f"robot{odd}") for n, ended, _, odd, _ in given_episodes
    ]
    _, counters = after(NO_FILL, *made)
    stored = msgpack.unpackb(msgpack.packb(asdict(counters)))
    assert Counters.from_dict(stored) == counters


@pytest.mark.parametrize(
    "damaged",
    [
        {},
        {"robots": None},
        {"robots": {"r": 3}},
        {"robots": {"r": {"lives": 9}}},
        {"robots": {}, "x": 1},
    ],
)
def test_damaged_counters_are_told_as_such(damaged: dict[str, Any]) -> None:
    with pytest.raises(StateError, match="damaged"):
        Counters.from_dict(damaged)


def test_accepting_leaves_the_counters_before_as_they_were() -> None:
    before = Counters()
    _, counters = accept(before, NO_FILL, make_episode(3))
    assert before == Counters()
    assert counters != before
