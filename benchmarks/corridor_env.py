"""The corridor as a Gymnasium environment, so that other projects' learners can drive in it."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from services.robot_driver.driver import Driver
from services.robot_driver.sim import SimRobot
from services.robot_driver.world import load_world
from shared.config import Config
from shared.messages import image_array
from shared.rl.policy import ACTIONS
from shared.rl.preprocess import HEIGHT, WIDTH

LIFE = "0" * 12
Image = npt.NDArray[np.uint8]


class CorridorEnv(gymnasium.Env[Image, np.int64]):
    """One simulated robot behind its driver: grey image in, one of three actions out.

    The reward is the part of the longest possible way that the robot got on, -1 at a bump. A bump
    ends an episode, 500 actions without one cut it off. The next episode goes on from there, after
    the robot has backed off; with a seed it begins at the start pose instead.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(self, config: Config | None = None) -> None:
        self._config = config or Config()
        robot = self._config.robot
        self._robot = SimRobot(robot, load_world(robot.world), self._config.run.seed)
        self._start = self._robot.state()
        self._driver = Driver(self._config, self._robot, LIFE)
        self._longest_m = robot.speed_m_s * robot.period_s
        self._actions = 0
        self._bumped = False
        self.observation_space = spaces.Box(0, 255, (HEIGHT, WIDTH, 1), np.uint8)
        self.action_space = spaces.Discrete(ACTIONS)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Image, dict[str, Any]]:
        """Begin an episode: recovered from the last bump, or at the start pose with a seed."""
        super().reset(seed=seed, options=options)
        if seed is not None:
            self._restart(seed)
        elif self._bumped:
            self._driver.settle(True)
        self._actions, self._bumped = 0, False
        return self._look(), {}

    def step(self, action: np.int64) -> tuple[Image, float, bool, bool, dict[str, Any]]:
        """Drive one action and look."""
        before = self._robot.pose
        self._driver.start(int(action))
        self._bumped = self._driver.advance(self._config.robot.period_s)
        if not self._bumped:  # what follows a bump belongs to the reset
            self._driver.settle(False)
        self._actions += 1
        after = self._robot.pose
        way_m = math.hypot(after.x_m - before.x_m, after.y_m - before.y_m)
        reward = -1.0 if self._bumped else way_m / self._longest_m
        truncated = self._actions >= self._config.episode.max_samples and not self._bumped
        return self._look(), reward, self._bumped, truncated, {}

    def close(self) -> None:
        """Free the simulation. May be called twice."""
        self._robot.close()

    def _look(self) -> Image:
        return image_array(self._driver.observe().image)[:, :, np.newaxis]

    def _restart(self, seed: int) -> None:
        """Put the robot to the start pose and draw recoveries anew from this seed."""
        run = self._config.run.model_copy(update={"seed": seed})
        self._robot.restore(self._start)
        self._driver = Driver(self._config.model_copy(update={"run": run}), self._robot, LIFE)
