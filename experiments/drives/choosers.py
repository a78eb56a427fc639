"""Who drives when nothing is learnt: a frozen network, the planner that knows the map, chance."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from services.robot_driver.atlas.action_geometry import ActionGeometry
from services.robot_driver.atlas.planner import Planner
from services.robot_driver.simulated.world import World
from shared.config import ActorNumerics, PolicyConfig, RobotConfig
from shared.messages import Observation, image_array
from shared.rl.draws import generator
from shared.rl.policy import choose, choose_uniformly

Chooser = Callable[[Sequence[Observation], Sequence[np.random.Generator]], list[int]]
"""Chooses an action for each robot: by what it perceives, and with the generator of its drive.

Whenever it is called, the robots are the same ones in the same order.
"""

GREEDY = PolicyConfig(kind="eps-greedy", epsilon=0.0)
PLAN_ACTIONS = 50
"""A plan is followed so far at most."""
GRID_M, HEADINGS, HORIZON = 0.1, 36, 100
"""Tables of the planner: coarse, as they only guide it; each action is checked exactly."""
KEEP_M = 0.2
"""Room that planned laps keep to all walls."""
MISTAKES = 0.2
"""Share of a demonstrator's actions that are by chance."""
_OFF_PLAN_M = 1e-3
IMAGES_PER_PASS = 8
"""Larger passes save little more time per image, and would be half empty with few robots."""


class Predicts(Protocol):
    """A network that tells the values of all actions."""

    def all_values(self, images: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
        """Values float32 [n, 3] of images uint8 [n, 50, 75]."""


def side_by_side(numerics: ActorNumerics) -> ActorNumerics:
    """The same arithmetic, in passes for many robots: the last bits of values may be others."""
    return numerics.model_copy(update={"batch": IMAGES_PER_PASS, "cuda_batch": IMAGES_PER_PASS})


def greedy(network: Predicts) -> Chooser:
    """The best actions by the predictions, exact ties drawn (E8). All are predicted at once."""

    def chosen(
        observations: Sequence[Observation], draws: Sequence[np.random.Generator]
    ) -> list[int]:
        values = network.all_values(np.stack([image_array(seen.image) for seen in observations]))
        return [choose(mine, GREEDY, draw)[0] for mine, draw in zip(values, draws, strict=True)]

    return chosen


def uniform(
    observations: Sequence[Observation],  # noqa: ARG001
    draws: Sequence[np.random.Generator],
) -> list[int]:
    """Any actions: the floor of all figures."""
    return [choose_uniformly(draw) for draw in draws]


def demonstrator(world: World, robot: RobotConfig, seed: int) -> Callable[[Observation], int]:
    """In place of a person who shows how to drive: the planner, every fifth action by chance.

    Without mistakes no sample would tell of a bump.
    """
    planned = Planned(world, robot)

    def wish(observation: Observation) -> int:
        draw = generator(seed, "person", observation.sequence)
        if draw.random() < MISTAKES:
            return choose_uniformly(draw)
        return planned([observation], [draw])[0]

    return wish


class _Plan(NamedTuple):
    """What one robot is to do next: actions, and where it stands before each, float64 [2]."""

    actions: list[int]
    places: list[npt.NDArray[np.float64]]


class Planned:
    """Drives by the map: the ceiling of what the actions can do.

    Where there is a lap centre it drives laps, in the direction it looks when it plans; elsewhere
    it keeps as far from walls as it can, which says how few bumps are possible but nothing about
    getting anywhere.
    """

    def __init__(self, world: World, robot: RobotConfig) -> None:
        self._planner = Planner(
            world, ActionGeometry.of(robot), cell_m=GRID_M, headings=HEADINGS, horizon=HORIZON
        )
        self._plans: dict[int, _Plan] = {}
        """Plans, by the robot's place in the order."""

    def __call__(
        self,
        observations: Sequence[Observation],
        draws: Sequence[np.random.Generator],  # noqa: ARG002
    ) -> list[int]:
        """The next action of every robot's plan."""
        return [self._next(number, seen) for number, seen in enumerate(observations)]

    def _next(self, number: int, observation: Observation) -> int:
        """The next action; by a new plan when the robot is not where the old one led."""
        here = np.array([observation.x_m, observation.y_m])
        plan = self._plans.get(number)
        if not (plan and plan.actions) or np.hypot(*(plan.places[0] - here)) > _OFF_PLAN_M:
            plan = self._plans[number] = self._plan(np.array([*here, observation.heading_rad]))
        plan.places.pop(0)
        return plan.actions.pop(0)

    def _plan(self, pose: npt.NDArray[np.float64]) -> _Plan:
        lap = self._planner.world.lap
        if lap is None:
            run = self._planner.drive(pose[None], PLAN_ACTIONS)
        else:
            cx, cy = lap.centre
            outward = math.atan2(pose[1] - cy, pose[0] - cx)
            direction = 1 if math.sin(pose[2] - outward) > 0.0 else -1
            run = self._planner.race(pose, PLAN_ACTIONS, direction, KEEP_M)
        safe = max(1, int(run.survived[0]))  # where nothing is safe, the best there is
        return _Plan(run.actions[:safe, 0].tolist(), list(run.poses[:safe, 0, :2]))
