"""Counter-based randomness: a function of seed, role and position only."""

from __future__ import annotations

import numpy as np
import pytest

from shared.rl.draws import generator


def first(*place: object) -> tuple[float, ...]:
    return tuple(generator(*place).random(4))  # type: ignore[arg-type]


def test_the_same_place_draws_the_same_whatever_was_drawn_before() -> None:
    expected = first(1, "policy", "robot1", 3, 7)
    other = generator(1, "policy", "robot1", 3, 8)
    other.random(1000)
    assert first(1, "policy", "robot1", 3, 7) == expected


@pytest.mark.parametrize(
    "other",
    [
        (2, "policy", "robot1", 3, 7),
        (1, "fill", "robot1", 3, 7),
        (1, "policy", "robot2", 3, 7),
        (1, "policy", "robot1", 4, 7),
        (1, "policy", "robot1", 3, 8),
        (1, "policy", "robot1", 7, 3),
        (1, "policy", "robot1", 37),
        (1, "policy", "robot1", 3),
        (1, "policy", "robot1", 3, "7"),
        (1, "policy", "robot13", 7),
        (1, "policyrobot1", 3, 7),
    ],
)
def test_any_difference_gives_another_stream(other: tuple[object, ...]) -> None:
    assert first(*other) != first(1, "policy", "robot1", 3, 7)


def test_the_streams_are_those_of_earlier_versions() -> None:
    """A change here makes every stored run continue differently."""
    found = [float(x) for x in generator(1, "policy", "robot1", 0, 0).random(2)]
    assert found == [0.6610067706021248, 0.3962086236832679]


def test_streams_of_neighbouring_places_are_unrelated() -> None:
    draws = np.array(
        [generator(5, "policy", "robot1", e, s).random() for e in range(40) for s in range(40)]
    )
    assert abs(draws.mean() - 0.5) < 0.03
    assert abs(np.corrcoef(draws[:-1], draws[1:])[0, 1]) < 0.1
    assert len(set(draws)) == len(draws)


def test_the_largest_seed_is_allowed() -> None:
    assert first(2**63 - 1, "policy") != first(0, "policy")
