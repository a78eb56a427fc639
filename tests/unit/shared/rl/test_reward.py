"""Eq 3.1-3.3 against loops over samples (A14-A17, E2, E5-E7, E38)."""

from __future__ import annotations

import math

import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared.config import RewardConfig
from shared.rl.reward import bump_penalty, episode_rewards, travelled

CONFIG = RewardConfig()
FAST = settings(deadline=None, max_examples=60, derandomize=True)
coordinates = st.floats(-4.0, 4.0, width=32)
places = st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=40)
q_values = st.floats(-1.0, 1.0, width=32)


def rewards(
    xy: list[tuple[float, float]], q: list[float], *, bump: bool, horizon: int, reach: float = 5.0
) -> list[float]:
    found = episode_rewards(
        np.array(xy), np.array(q), bump=bump, horizon=horizon, max_distance_m=reach, config=CONFIG
    )
    assert found.dtype == np.float32
    return [float(r) for r in found]


@FAST
@given(xy=places, horizon=st.integers(1, 50), data=st.data())
def test_rewards_of_a_bump_episode_equal_loops_and_stay_in_range(
    xy: list[tuple[float, float]], horizon: int, data: st.DataObject
) -> None:
    q = data.draw(st.lists(q_values, min_size=len(xy), max_size=len(xy)))
    found = rewards(xy, q, bump=True, horizon=horizon)
    assert found == pytest.approx(oracles.rewards(xy, q, True, horizon, 5.0), abs=1e-6)
    assert found[-1] == -1.0
    assert all(-0.92 - 1e-6 <= r <= 1.0 for r in found[:-1])


@FAST
@given(released=st.integers(0, 20), horizon=st.integers(1, 20), data=st.data())
def test_rewards_without_a_bump_equal_loops_and_stay_in_range(
    released: int, horizon: int, data: st.DataObject
) -> None:
    n = released + horizon
    xy = data.draw(st.lists(st.tuples(coordinates, coordinates), min_size=n, max_size=n))
    q = data.draw(st.lists(q_values, min_size=released, max_size=released))
    found = rewards(xy, q, bump=False, horizon=horizon)
    assert found == pytest.approx(oracles.rewards(xy, q, False, horizon, 5.0), abs=1e-6)
    assert all(-0.2 - 1e-6 <= r <= 1.0 for r in found)


def test_full_episode_of_500_releases_450_whose_farthest_look_is_the_last_position() -> None:
    xy = [(0.0, 0.0)] * 499 + [(3.0, 4.0)]
    found = rewards(xy, [0.0] * 450, bump=False, horizon=50, reach=10.0)
    assert found[448:] == pytest.approx([0.0, 0.8 * 0.5])
    with pytest.raises(ValueError, match="500"):
        rewards(xy, [0.0] * 451, bump=False, horizon=50)


def test_look_ahead_reaches_exactly_fifty_steps_and_no_further() -> None:
    near = rewards([(0.0, 0.0)] * 50 + [(5.0, 0.0)] * 2, [0.0, 0.0], bump=False, horizon=50)
    assert near == pytest.approx([0.8, 0.8])
    xy = [(0.0, 0.0)] * 51 + [(5.0, 0.0)]
    assert rewards(xy, [0.0, 0.0], bump=False, horizon=50) == pytest.approx([0.0, 0.8])


@pytest.mark.parametrize("given", [0, 2, 4])
def test_a_bump_must_release_all_samples(given: int) -> None:
    with pytest.raises(ValueError, match="releases all"):
        rewards([(0.0, 0.0)] * 3, [0.0] * given, bump=True, horizon=50)


def test_a_bump_of_no_samples_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        rewards([], [], bump=True, horizon=50)


def test_terminal_sample_bypasses_distance_and_prediction() -> None:
    assert rewards([(0.0, 0.0)], [1.0], bump=True, horizon=50) == [-1.0]


def test_odometry_that_overshoots_is_clipped_to_one() -> None:
    found = rewards([(0.0, 0.0), (99.0, 0.0)], [-1.0], bump=False, horizon=1)
    assert found == pytest.approx([0.6])  # 0.8 of the distance, less 0.2 of the prediction


def test_lowest_and_highest_reward_before_the_terminal_sample() -> None:
    assert rewards([(0.0, 0.0)] * 2, [-1.0, 0.0], bump=True, horizon=50)[0] == pytest.approx(-0.92)
    far = [(0.0, 0.0)] + [(9.0, 0.0)] * 51
    assert rewards(far, [1.0] * 52, bump=True, horizon=50)[0] == pytest.approx(1.0)


def test_penalty_counts_down_to_the_bump_and_starts_below_fifty_steps() -> None:
    found = bump_penalty(np.array([0, 1, 2, 49, 50, 51, 400]), 0.9, 50)
    expected = [-1.0, -0.9, -0.81, -(0.9**49), 0.0, 0.0, 0.0]
    assert list(found) == pytest.approx(expected)


def test_farthest_point_counts_not_the_last_one() -> None:
    there_and_back = np.array([(0.0, 0.0), (2.0, 0.0), (0.0, 0.0)])
    assert list(travelled(there_and_back, np.array([2, 2, 2]), 4.0)) == [0.5, 0.5, 0.0]


def test_travelled_nothing_at_all() -> None:
    assert travelled(np.zeros((0, 2)), np.zeros(0, np.int64), 1.0).shape == (0,)


def test_driving_straight_at_a_wall_turns_negative_at_twelve_steps_before_it() -> None:
    """The check of A17: n / 50 < 0.9^n exactly for n <= 12, before the Q term."""
    reach, steps = 7.5, 60
    xy = [(reach / 50 * t, 0.0) for t in range(steps)]
    found = rewards(xy, [0.0] * steps, bump=True, horizon=50, reach=reach)
    negative = [steps - 1 - t for t, reward in enumerate(found) if reward < 0.0]
    assert negative == list(range(12, -1, -1))
    assert found[steps - 1 - 13] == pytest.approx(0.8 * (13 / 50 - 0.9**13), abs=1e-6)


def test_weights_and_decay_come_from_the_configuration() -> None:
    config = RewardConfig(observed_weight=0.5, prediction_weight=0.1, bump_decay=0.5)
    found = episode_rewards(
        np.array([(0.0, 0.0), (3.0, 4.0), (3.0, 4.0)]),
        np.array([0.4, 0.0, 0.0]),
        bump=True,
        horizon=50,
        max_distance_m=10.0,
        config=config,
    )
    assert list(found) == pytest.approx([0.5 * (0.5 - 0.25) + 0.04, 0.5 * -0.5, -1.0])
    assert not math.isnan(found[0])
