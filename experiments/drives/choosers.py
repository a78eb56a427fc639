"""Who drives when nothing is learnt: a frozen network, the planner that knows the map, chance."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np
import numpy.typing as npt

from services.robot_driver.atlas.action_geometry import ActionGeometry
from services.robot_driver.atlas.planner import Planner
from services.robot_driver.simulated.world import World
from shared.config import PolicyConfig, RobotConfig
from shared.messages import Observation, image_array
from shared.rl.policy import choose, choose_uniformly

Chooser = Callable[[Observation, np.random.Generator], int]
"""Chooses an action for what the robot perceives, and the generator of its drive."""

GREEDY = PolicyConfig(kind="eps-greedy", epsilon=0.0)
PLAN_ACTIONS = 50
"""A plan is followed so far at most."""
GRID_M, HEADINGS, HORIZON = 0.1, 36, 100
"""Tables of the planner: coarse, as they only guide it; each action is checked exactly."""
KEEP_M = 0.2
"""Room that planned laps keep to all walls."""
_OFF_PLAN_M = 1e-3


class Predicts(Protocol):
    """A network that tells the values of all actions."""

    def all_values(self, images: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
        """Values float32 [n, 3] of images uint8 [n, 50, 75]."""


def greedy(network: Predicts) -> Chooser:
    """The best action by the predictions, exact ties drawn (E8)."""

    def chosen(observation: Observation, draw: np.random.Generator) -> int:
        values = network.all_values(image_array(observation.image)[None])[0]
        return choose(values, GREEDY, draw)[0]

    return chosen


def uniform(observation: Observation, draw: np.random.Generator) -> int:  # noqa: ARG001
    """Any action: the floor of all figures."""
    return choose_uniformly(draw)


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
        self._actions: list[int] = []
        self._places: list[npt.NDArray[np.float64]] = []

    def __call__(self, observation: Observation, draw: np.random.Generator) -> int:  # noqa: ARG002
        """The next action of the plan; a new plan when the robot is not where the old one led."""
        here = np.array([observation.x_m, observation.y_m])
        if not self._actions or np.hypot(*(self._places[0] - here)) > _OFF_PLAN_M:
            self._plan(np.array([*here, observation.heading_rad]))
        self._places.pop(0)
        return self._actions.pop(0)

    def _plan(self, pose: npt.NDArray[np.float64]) -> None:
        lap = self._planner.world.lap
        if lap is None:
            run = self._planner.drive(pose[None], PLAN_ACTIONS)
        else:
            cx, cy = lap.centre
            outward = math.atan2(pose[1] - cy, pose[0] - cx)
            direction = 1 if math.sin(pose[2] - outward) > 0.0 else -1
            run = self._planner.race(pose, PLAN_ACTIONS, direction, KEEP_M)
        safe = max(1, int(run.survived[0]))  # where nothing is safe, the best there is
        self._actions = run.actions[:safe, 0].tolist()
        self._places = list(run.poses[:safe, 0, :2])
