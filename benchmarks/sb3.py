"""DQN of Stable-Baselines3 on our environment, with a network shaped like ours.

Stable-Baselines3 is no dependency of this project: `make bench-peers` installs it apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3 import DQN
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor
from torch.nn import functional as F  # noqa: N812  (the customary name)

from experiments.drives.choosers import Chooser
from shared.config import Config, NetworkConfig
from shared.messages import Observation, image_array
from shared.rl.network import initialised

HIDDEN = 128
"""Units of FConn1 and FConn3."""


class Trunk(BaseFeaturesExtractor):  # type: ignore[misc]
    """Our convolutions, pools and FConn1 (Fig 3.6), with the weights that we begin with (A23)."""

    def __init__(self, space: gymnasium.Space[object], network: NetworkConfig, seed: int) -> None:
        super().__init__(space, HIDDEN)
        self.ours = initialised(network, seed)
        del self.ours.fconn2, self.ours.fconn3, self.ours.out  # its head has an output per action
        for parameter in self.ours.parameters():  # the usual layout: how ours lie is ours alone
            parameter.data = parameter.data.contiguous()

    def forward(self, images: Tensor) -> Tensor:
        """Features [n, 128] of images [n, 1, 50, 75] in [0, 1]."""
        return F.relu(self.ours.fconn1(self.ours.maps(images).flatten(1)))


def dqn(env: gymnasium.Env[Any, Any], config: Config, *, random_steps: int, **given: Any) -> DQN:
    """DQN on the CPU: its defaults, but what both sides share, and what is `given` to it.

    Shared are the shape of the network, memory, mini-batch, exploration, and the random actions
    before training.
    """
    shape = {
        "features_extractor_class": Trunk,
        "features_extractor_kwargs": {"network": config.network, "seed": config.run.seed},
        "net_arch": [HIDDEN],
    }
    return DQN(
        "CnnPolicy", env, device="cpu", seed=config.run.seed, policy_kwargs=shape,
        batch_size=config.learning.batch_size, buffer_size=config.memory.capacity,
        learning_starts=random_steps, exploration_initial_eps=config.policy.epsilon,
        exploration_final_eps=config.policy.epsilon, **given,
    )  # fmt: skip


def greedy(model: DQN) -> Chooser:
    """The best action by its predictions."""

    def chosen(seen: Sequence[Observation], draws: Sequence[np.random.Generator]) -> list[int]:  # noqa: ARG001
        # A copy of each image: PyTorch wants to own it.
        images = (image_array(each.image)[:, :, np.newaxis].copy() for each in seen)
        return [int(model.predict(image, deterministic=True)[0]) for image in images]

    return chosen
