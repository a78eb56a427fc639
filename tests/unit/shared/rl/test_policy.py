"""Action policies against their definitions (A18-A20, E8, E12, E13)."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared.config import Config, PolicyConfig
from shared.rl.draws import generator
from shared.rl.policy import choose, choose_uniformly, decide, distribution

Kind = Literal["eps-greedy", "roulette", "eps-greedy-roulette"]
KINDS: tuple[Kind, ...] = ("eps-greedy", "roulette", "eps-greedy-roulette")
FAST = settings(deadline=None, max_examples=80, derandomize=True)
q_values = st.one_of(
    st.lists(st.sampled_from([-1.0, -0.5, 0.0, 1.0]), min_size=3, max_size=3),
    st.lists(st.floats(-1.0, 1.0, width=32), min_size=3, max_size=3),
)


class Scripted:
    """Stands in for a generator: hands out given numbers in [0, 1)."""

    def __init__(self, *numbers: float) -> None:
        self.numbers = list(numbers)

    def random(self, n: int) -> np.ndarray:
        taken, self.numbers = self.numbers[:n], self.numbers[n:]
        return np.array(taken)


def naive(q: list[float], config: PolicyConfig) -> list[float]:
    best = [i for i in range(3) if q[i] == max(q)]
    greedy = [1 / len(best) if i in best else 0.0 for i in range(3)]
    weights = [math.exp((value - max(q)) / config.temperature) for value in q]
    roulette = [w / sum(weights) for w in weights]
    if config.kind == "roulette":
        return roulette
    explore = [1 / 3] * 3 if config.kind == "eps-greedy" else roulette
    return [
        (1 - config.epsilon) * g + config.epsilon * e for g, e in zip(greedy, explore, strict=True)
    ]


@FAST
@given(
    q=q_values,
    kind=st.sampled_from(KINDS),
    epsilon=st.floats(0.0, 1.0),
    temperature=st.floats(0.01, 5.0),
)
def test_distribution_equals_the_definition(
    q: list[float], kind: Kind, epsilon: float, temperature: float
) -> None:
    config = PolicyConfig(kind=kind, epsilon=epsilon, temperature=temperature)
    found = distribution(np.array(q, np.float32), config)
    assert list(found) == pytest.approx(naive(q, config), abs=1e-9)
    assert found.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "q",
    [(0.3, 0.28, -0.5), (0.5, 0.5, 0.49), (1.0, 1.0, 1.0), (-1.0, -1.0, -0.999), (0.0, -1.0, 0.0)],
)
def test_frequencies_of_choose_follow_the_distribution(
    kind: Kind, q: tuple[float, float, float]
) -> None:
    config, draws = PolicyConfig(kind=kind, epsilon=0.3), 6000
    values, rng = np.array(q, np.float32), np.random.default_rng(7)
    counts, greedy = [0, 0, 0], 0
    for _ in range(draws):
        action, by_greed = choose(values, config, rng)
        counts[action] += 1
        greedy += by_greed
    for count, chance in zip(counts, naive([float(v) for v in values], config), strict=True):
        spread = math.sqrt(draws * chance * (1 - chance))
        assert abs(count - draws * chance) <= 5 * spread
    expected = 0.0 if kind == "roulette" else 0.7
    assert abs(greedy - draws * expected) <= 5 * math.sqrt(draws * expected * 0.3)


def test_defaults_are_those_of_the_thesis() -> None:
    config = PolicyConfig()
    assert (config.kind, config.epsilon, config.temperature) == ("eps-greedy-roulette", 0.1, 0.01)


def test_values_at_both_ends_of_the_range_do_not_overflow_the_softmax() -> None:
    for kind in KINDS:
        found = distribution(np.array([1.0, -1.0, 1.0], np.float32), PolicyConfig(kind=kind))
        assert np.isfinite(found).all()
        assert found[1] < 0.05
    cold = PolicyConfig(kind="roulette", temperature=1e-300)
    with np.errstate(over="ignore"):
        assert list(distribution(np.array([0.5, 0.5, 0.4], np.float32), cold)) == [0.5, 0.5, 0.0]


def test_the_greedy_choice_is_the_action_not_its_value() -> None:
    config = PolicyConfig(kind="eps-greedy", epsilon=0.0)
    rng = np.random.default_rng(1)
    assert choose(np.array([0.1, 0.2, 0.9], np.float32), config, rng) == (2, True)
    assert choose(np.array([-0.1, -0.9, -0.8], np.float32), config, rng) == (0, True)


@pytest.mark.parametrize("clipped", [1.0, -1.0])
def test_clipped_ties_are_broken_at_random_and_evenly(clipped: float) -> None:
    config = PolicyConfig(kind="eps-greedy", epsilon=0.0)
    values, rng = np.full(3, clipped, np.float32), np.random.default_rng(3)
    counts = np.bincount([choose(values, config, rng)[0] for _ in range(3000)], minlength=3)
    assert (abs(counts - 1000) < 130).all()


def test_a_draw_equal_to_epsilon_is_greedy() -> None:
    config, values = PolicyConfig(epsilon=0.1), np.array([0.0, 1.0, 0.0], np.float32)
    assert choose(values, config, Scripted(0.1, 0.5)) == (1, True)
    assert choose(values, config, Scripted(np.nextafter(0.1, 0.0), 0.5)) == (1, False)


def test_epsilon_zero_never_explores_and_one_always_does() -> None:
    values, rng = np.array([0.0, 0.1, 0.2], np.float32), np.random.default_rng(5)
    never, always = PolicyConfig(epsilon=0.0), PolicyConfig(epsilon=1.0)
    assert all(choose(values, never, rng) == (2, True) for _ in range(50))
    assert not any(choose(values, always, rng)[1] for _ in range(50))


def test_random_actions_of_eps_greedy_include_the_best_one() -> None:
    config = PolicyConfig(kind="eps-greedy", epsilon=0.3)
    found = distribution(np.array([0.9, 0.0, 0.0], np.float32), config)
    assert list(found) == pytest.approx([0.8, 0.1, 0.1])


@pytest.mark.parametrize("draw", [0.0, 0.5, np.nextafter(1.0, 0.0)])
def test_rounding_never_picks_an_impossible_action(draw: float) -> None:
    for best in range(3):
        values = np.full(3, -1.0, np.float32)
        values[best] = 1.0
        cold = PolicyConfig(kind="roulette", temperature=0.001)
        assert choose(values, cold, Scripted(0.9, draw))[0] == best


def test_filling_actions_are_uniform() -> None:
    rng = np.random.default_rng(11)
    counts = np.bincount([choose_uniformly(rng) for _ in range(3000)], minlength=4)
    assert counts[3] == 0
    assert (abs(counts[:3] - 1000) < 130).all()


def test_filling_draws_apart_from_driving() -> None:
    config, values = Config(), np.zeros(3, np.float32)
    draws = [generator(config.run.seed, "fill", "robot", 2, step) for step in range(50)]
    filled = [decide(config, "robot", values, filling=True, episode=2, step=s) for s in range(50)]
    assert filled == [(choose_uniformly(draw), "chance") for draw in draws]
