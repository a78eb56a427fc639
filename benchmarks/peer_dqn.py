"""Stable-Baselines3's DQN in the corridor, with a network shaped like ours."""

from __future__ import annotations

import torch
from gymnasium.wrappers import TimeLimit

from benchmarks import sb3
from experiments.environment import CorridorEnv
from shared.config import Config


class Baseline:
    """DQN as its users run it: on the CPU, with as many threads as PyTorch takes by itself.

    Everything is its default but what both sides share, and one mini-batch every four steps.
    """

    def __init__(self, config: Config, batch: int, every: int, random_steps: int) -> None:
        self._threads = torch.get_num_threads()
        self.env = TimeLimit(CorridorEnv(config=config), config.episode.max_samples)
        learning = config.learning.model_copy(update={"batch_size": batch})
        self.model = sb3.dqn(
            self.env, config.model_copy(update={"learning": learning}),
            random_steps=random_steps, train_freq=every, gradient_steps=1,
        )  # fmt: skip

    def drive(self, steps: int) -> None:
        """Drive this many steps, with the training that falls due."""
        torch.set_num_threads(self._threads)
        self.model.learn(steps, reset_num_timesteps=False)

    @property
    def mini_batches(self) -> int:
        """Mini-batches trained so far."""
        return int(self.model._n_updates)

    @property
    def parameters(self) -> int:
        """Trained parameters of its network."""
        return sum(p.numel() for p in self.model.q_net.parameters())

    def close(self) -> None:
        """Free the simulation."""
        self.env.close()
