"""Predictions beside what then happened, against sums written out one by one."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
from builders import make_config

from experiments.drives.predictions import BEFORE_WALL, figures, judged, prediction_figures
from experiments.drives.traces import Trace
from experiments.environment import CorridorEnv
from shared.config import Config
from shared.messages import image_array

CONFIG = make_config()
HORIZON = 50


def trace(bumps: npt.NDArray[np.bool_], seed: int) -> Trace:
    """A robot that wanders about."""
    n, draw = len(bumps), np.random.default_rng(seed)
    places = np.cumsum(draw.uniform(-0.1, 0.2, (n + 1, 2)), axis=0)
    zeros = np.zeros(n)
    return Trace("plus", bumps, places, np.zeros(n + 1), zeros, 0, 0)


def naive(
    way: Trace, values: npt.NDArray[np.float32], chosen: npt.NDArray[np.int64]
) -> list[tuple[float, float, bool]]:
    """Eq 3.1 for one action after the other; only those whose look-ahead was seen."""
    found = []
    bumps = np.flatnonzero(way.bumps)
    for t, action in enumerate(chosen):
        later = bumps[bumps >= t]
        bump = int(later[0]) if len(later) else None
        if bump is None and t + HORIZON >= len(chosen):
            continue
        q = float(values[t, action])
        near = bump is not None and bump - t < BEFORE_WALL
        if bump == t:
            found.append((q, -1.0, near))
            continue
        last = t + HORIZON if bump is None else min(bump, t + HORIZON)
        ways = [math.dist(way.places_m[t], way.places_m[i]) for i in range(t + 1, last + 1)]
        distance = min(1.0, max(ways, default=0.0) / CONFIG.max_distance_m)
        penalty = -(0.9 ** (bump - t)) if bump is not None and bump - t < HORIZON else 0.0
        reward = 0.8 * (distance + penalty) + 0.2 * float(values[t + 1].max())
        found.append((q, reward, near))
    return found


@pytest.mark.parametrize(
    "bumps", [[], [3], [0], [99], [10, 11, 60], [20, 90, 99], list(range(0, 100, 7))]
)
def test_rewards_are_those_of_the_equation(bumps: list[int]) -> None:
    at, draw = np.zeros(100, np.bool_), np.random.default_rng(len(bumps))
    at[bumps] = True
    way = trace(at, 3)
    values = draw.uniform(-1.0, 1.0, (100, 3)).astype(np.float32)
    chosen = draw.integers(0, 3, 100)
    found = judged(way, values, chosen, CONFIG)
    expected = naive(way, values, chosen)
    np.testing.assert_allclose(found, np.array(expected).reshape(-1, 3).T, atol=1e-6)


def test_figures_tell_how_far_predictions_reach() -> None:
    observed = np.linspace(-1.0, 1.0, 40)
    walls = observed < -0.5
    exact = figures(np.stack([observed, observed, walls]))
    assert exact["value_rank"] == pytest.approx(1.0)
    assert exact["value_slope"] == pytest.approx(1.0)
    assert exact["wall_value"] == pytest.approx(observed[walls].mean())
    flat = figures(np.stack([0.2 + 0.1 * observed, observed, walls]))
    assert (flat["value_rank"], flat["value_slope"]) == (pytest.approx(1.0), pytest.approx(10.0))


def test_what_cannot_be_told_is_no_number() -> None:
    same, none = np.full(9, 0.3), np.zeros(9)
    for found in (np.stack([same, same, none]), np.zeros((3, 0))):
        assert all(math.isnan(value) for value in figures(found).values())


class Bright:
    """Expects more, the brighter the picture; the right turn seems best by a little."""

    def all_values(self, images: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
        """float32 [n, 3]."""
        level = images.reshape(len(images), -1).mean(axis=1, dtype=np.float32) / 255.0
        return np.stack([level - 0.1, level, level + 0.01], axis=1).astype(np.float32)


def test_a_real_drive_is_judged_and_says_the_same_twice() -> None:
    config: Config = CONFIG
    env = CorridorEnv(config=config)
    found = [prediction_figures(env, Bright(), 3, 80) for _ in range(2)]
    level = image_array(env.observe().image).mean() / 255.0
    env.close()
    assert found[0] == found[1]
    assert abs(found[0]["wall_value"] - level) < 0.5
    assert -1.0 <= found[0]["value_rank"] <= 1.0
