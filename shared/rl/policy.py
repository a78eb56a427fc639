"""Action policies (section 3.3): eps-greedy, roulette, their mixture; the decision of an actor."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from shared import plugins
from shared.facts import ACTION_COUNT, Chooser
from shared.rl.draws import generator

if TYPE_CHECKING:
    from shared.config import Config, PolicyConfig

Values = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]


def greedy_distribution(values: Values) -> Floats:
    """All probability on argmax_a Q(s, a) (E12), shared equally between exact ties (E8)."""
    best = values == values.max()
    return np.asarray(best / best.sum())


def roulette_distribution(values: Values, temperature: float) -> Floats:
    """Softmax of Q / temperature (Fig 3.4); the maximum is subtracted first (E13)."""
    scaled = (values.astype(np.float64) - float(values.max())) / temperature
    weights = np.exp(scaled)
    return np.asarray(weights / weights.sum())


def exploring_distribution(values: Values, config: PolicyConfig) -> Floats:
    """What the policy draws from when it does not act greedily."""
    if config.kind == "eps-greedy":
        return np.full(len(values), 1.0 / len(values))
    if config.kind in ("roulette", "eps-greedy-roulette"):
        return roulette_distribution(values, config.temperature)
    return np.asarray(plugins.load(plugins.POLICIES, config.kind)(values, config), np.float64)


def distribution(values: Values, config: PolicyConfig) -> Floats:
    """Probability of each action: float64 [actions], given clipped Q values [actions]."""
    explore = exploring_distribution(values, config)
    if config.kind == "roulette":
        return explore
    return (1.0 - config.epsilon) * greedy_distribution(values) + config.epsilon * explore


def choose(values: Values, config: PolicyConfig, rng: np.random.Generator) -> tuple[int, bool]:
    """Draw an action; also tell whether the greedy branch chose it (Fig 3.3-3.5).

    values: float32 [actions], clipped predictions of the target network. Draws twice from `rng`:
    first the branch (greedy if u >= epsilon), then the action.
    """
    branch, draw = rng.random(2)
    greedy = config.kind != "roulette" and bool(branch >= config.epsilon)
    chances = greedy_distribution(values) if greedy else exploring_distribution(values, config)
    return _pick(chances, float(draw)), greedy


def decide(
    config: Config, robot: str, values: Values, *, filling: bool, episode: int, step: int
) -> tuple[int, Chooser]:
    """Choose an action (A13, A18-A20, E9); by the network's greedy branch, or chance.

    values: clipped Q of all actions, float32 [actions]. filling: the memory is still being filled.
    episode: fill submissions of the robot so far while filling, else its counted episodes. step: in
    its open episode.
    """
    role = "fill" if filling else "policy"
    draw = generator(config.run.seed, role, robot, episode, step)
    if filling and config.memory.fill == "random":
        return choose_uniformly(draw), "chance"
    action, greedy = choose(values, config.policy, draw)
    return action, "network" if greedy else "chance"


def choose_greedily(values: Values, rng: np.random.Generator) -> int:
    """The best action, exact ties drawn (E8); draws from `rng` as `choose` does."""
    return _pick(greedy_distribution(values), float(rng.random(2)[1]))


def choose_uniformly(rng: np.random.Generator) -> int:
    """A uniformly random action, to fill the memory before learning starts (E9)."""
    return int(rng.integers(ACTION_COUNT))


def _pick(chances: Floats, draw: float) -> int:
    """The action whose slice of [0, 1) holds `draw`; rounding can never pick an impossible one."""
    possible = np.flatnonzero(chances)
    index = int(np.searchsorted(np.cumsum(chances[possible]), draw, side="right"))
    return int(possible[min(index, len(possible) - 1)])
