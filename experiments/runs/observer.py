"""Looks at the network of a run with robots of its own, so that nothing of the run is disturbed."""

from __future__ import annotations

import math
from pathlib import Path

from experiments.drives.choosers import greedy
from experiments.drives.frozen_drives import drive_from_first_start, evaluate
from experiments.drives.references import reference
from experiments.drives.tour import Tour, drive_tour
from experiments.drives.traces import Figures, first_lap
from experiments.environment import CorridorEnv, with_world
from experiments.runs import probes
from experiments.runs.probes import Probes
from services.robot_driver.robot import Pose
from shared.config import Config, PolicyConfig
from shared.rl.predictor import Predictor

LAP_ACTIONS = 400
"""A frozen drive that has not gone round by then does not count as one that drives laps."""


class Observer:
    """One network, frozen, in any world: as its file says, whatever a run has changed there."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._network = Predictor(config.network, config.numerics.actor)
        self._envs: dict[str, CorridorEnv] = {}
        self._shown = b""

    def show(self, weights: bytes) -> None:
        """Look at these weights, safetensors bytes, from now on. Raises ValueError on a misfit."""
        if weights != self._shown:
            self._network.load(0, weights)
            self._shown = weights

    def evaluate(self, world: str, starts: int, actions: int) -> Figures:
        """Figures of greedy drives."""
        return evaluate(self._env(world), greedy(self._network), starts, actions).figures

    def drives_lap(self, world: str) -> bool:
        """Whether it drives round the lap centre without a bump, from the world's first start.

        Raises:
            ValueError: The world has no lap centre.
        """
        env = self._env(world)
        trace = drive_from_first_start(env, greedy(self._network), LAP_ACTIONS)
        return first_lap(trace, env.robot.world) is not None

    def look(self, world: str) -> Probes:
        """Pictures of a world, and what is predicted for them."""
        return probes.look(self._env(world).robot, self._network)

    def tours(self, world: str, count: int, policy: PolicyConfig) -> list[Tour]:
        """Test drives from the world's first start poses. Raises ValueError without a route."""
        env = self._env(world)
        poses = [
            Pose(start.x_m, start.y_m, math.radians(start.heading_deg))
            for start in env.robot.world.starts[:count]
        ]
        return [drive_tour(env, self._network, pose, n, policy) for n, pose in enumerate(poses)]

    def reference(self, world: str, driver: str, starts: int, actions: int, kept: Path) -> Figures:
        """Figures of the floor or the ceiling (`references.reference`)."""
        return reference(self._env(world), driver, starts, actions, kept)

    def close(self) -> None:
        """Free the simulations."""
        for env in self._envs.values():
            env.close()

    def _env(self, world: str) -> CorridorEnv:
        if world not in self._envs:
            self._envs[world] = CorridorEnv(config=with_world(self._config, world))
        return self._envs[world]
