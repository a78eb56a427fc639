"""When periodic steps are due, by episodes and by actions (E25, E39)."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from shared.rl.schedule import Moment, due


def test_by_episodes_it_is_due_at_every_multiple() -> None:
    assert [e for e in range(201) if due(Moment(e), 50)] == [50, 100, 150, 200]


@given(st.integers(0, 1000), st.integers(0, 10_000), st.integers(0, 500))
def test_it_is_never_due_without_a_period(episode: int, total: int, actions: int) -> None:
    assert not due(Moment(episode, total, actions), 0, 0)


@given(st.integers(0, 100), st.integers(0, 10_000))
def test_it_is_never_due_while_the_memory_is_filled(by_episodes: int, by_actions: int) -> None:
    assert not due(Moment(0, 10_000, 500), by_episodes, by_actions)


@settings(derandomize=True)
@given(st.lists(st.integers(1, 500), min_size=1, max_size=60), st.integers(1, 2000))
def test_by_actions_it_is_due_in_the_episode_that_reaches_a_multiple(
    lengths: list[int], every: int
) -> None:
    """Whatever the number of episodes says."""
    total, found = 0, []
    for episode, actions in enumerate(lengths, 1):
        total += actions
        if due(Moment(episode, total, actions), 1, every):
            found.append(episode)
    reached = [sum(lengths[: n + 1]) for n in range(len(lengths))]
    multiples = range(every, reached[-1] + 1, every)
    first = {next(n for n, t in enumerate(reached, 1) if t >= multiple) for multiple in multiples}
    assert found == sorted(first)
