"""Stable-Baselines3's DQN in the corridor, with a network shaped like ours."""

from __future__ import annotations

import gymnasium
import torch
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import DQN
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from experiments.environment import CorridorEnv
from shared.config import Config
from shared.rl.network import MAP_HEIGHT, MAP_WIDTH

HIDDEN = 128


class Trunk(BaseFeaturesExtractor):
    """Four convolutions, two pools and the first full connection of Fig 3.6."""

    def __init__(self, space: gymnasium.Space[object], filters: int) -> None:
        super().__init__(space, HIDDEN)
        self.layers = nn.Sequential(
            nn.Conv2d(1, filters, 3), nn.ReLU(),
            nn.Conv2d(filters, filters, 3), nn.ReLU(), nn.MaxPool2d(2),
            nn.Conv2d(filters, filters, 3), nn.ReLU(),
            nn.Conv2d(filters, filters, 3), nn.ReLU(), nn.MaxPool2d(2),
            nn.Flatten(), nn.Linear(filters * MAP_HEIGHT * MAP_WIDTH, HIDDEN), nn.ReLU(),
        )  # fmt: skip

    def forward(self, images: Tensor) -> Tensor:
        """Features [n, 128] of images [n, 1, 50, 75] in [0, 1]."""
        return torch.as_tensor(self.layers(images))


class Baseline:
    """DQN as its users run it: on the CPU, with as many threads as PyTorch takes by itself.

    Everything is its default but what both sides share: size of network, mini-batch and memory,
    one mini-batch every four steps, exploration and the random steps before training.
    """

    def __init__(self, config: Config, batch: int, every: int, random_steps: int) -> None:
        self._threads = torch.get_num_threads()
        self.env = TimeLimit(CorridorEnv(config=config), config.episode.max_samples)
        shape = {
            "features_extractor_class": Trunk,
            "features_extractor_kwargs": {"filters": config.network.filters},
            "net_arch": [HIDDEN],
        }
        self.model = DQN(
            "CnnPolicy", self.env, device="cpu", seed=config.run.seed, policy_kwargs=shape,
            batch_size=batch, train_freq=every, gradient_steps=1, learning_starts=random_steps,
            buffer_size=config.memory.capacity, exploration_initial_eps=config.policy.epsilon,
            exploration_final_eps=config.policy.epsilon,
        )  # fmt: skip

    def drive(self, steps: int) -> None:
        """So many steps, with the training that falls due."""
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
