"""The baseline: the network as one writes it down first, in float32 and PyTorch's usual layout."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812  (the customary name)

from shared.config import LearningConfig, NetworkConfig
from shared.rl.descriptor import block_sums, describe
from shared.rl.memory import SampleStore
from shared.rl.network import QNetwork, load_bytes

Images = npt.NDArray[np.uint8]
BATCH = 128


def network(config: NetworkConfig, weights: bytes) -> QNetwork:
    """The same parameters as ours in a fresh module."""
    plain = QNetwork(config)
    load_bytes(plain, weights)
    return plain


def tensor(images: Images) -> Tensor:
    """uint8 [n, 50, 75] to float32 [n, 1, 50, 75] in [0, 1]."""
    return torch.from_numpy(images).unsqueeze(1).float() / 255.0


def maps(net: QNetwork, images: Images) -> Tensor:
    """Convolutions, each followed by its ReLU, and pools, in the order of Fig 3.6."""
    x = F.relu(net.conv1(tensor(images)))
    x = F.max_pool2d(F.relu(net.conv2(x)), 2)
    x = F.relu(net.conv3(x))
    return F.max_pool2d(F.relu(net.conv4(x)), 2)


@torch.no_grad()
def all_values(net: QNetwork, images: Images, threads: int) -> npt.NDArray[np.float32]:
    """Clipped values of all actions, trunk once and three heads, in mini-batches: [n, 3]."""
    torch.set_num_threads(threads)
    parts = [images[start : start + BATCH] for start in range(0, len(images), BATCH)]
    return np.concatenate([net.all_values(maps(net, p)).clamp(-1, 1).numpy() for p in parts])


@torch.no_grad()
def descriptors(net: QNetwork, images: Images, threads: int) -> Images:
    """Descriptors of images, in mini-batches: uint8 [n, 15]."""
    torch.set_num_threads(threads)
    parts = [images[start : start + BATCH] for start in range(0, len(images), BATCH)]
    return describe(np.concatenate([block_sums(maps(net, p)).numpy() for p in parts]))


class Step:
    """A training step on a whole mini-batch at once."""

    def __init__(
        self, config: NetworkConfig, learning: LearningConfig, weights: bytes, threads: int
    ) -> None:
        self.network, self.threads = network(config, weights), threads
        self._optimiser = torch.optim.RMSprop(
            self.network.parameters(),
            lr=learning.learning_rate,
            alpha=learning.rmsprop_alpha,
            eps=learning.rmsprop_epsilon,
        )

    def __call__(self, store: SampleStore, ranks: npt.NDArray[np.int64]) -> float:
        """One step; returns the loss."""
        torch.set_num_threads(self.threads)
        actions = torch.from_numpy(store.rows["action"][ranks].astype(np.int64))
        rewards = torch.from_numpy(store.rows["reward"][ranks])
        self._optimiser.zero_grad()
        values = self.network.values(maps(self.network, store.images(ranks)), actions)
        loss = F.mse_loss(values, rewards)
        torch.autograd.backward(loss)
        self._optimiser.step()
        return float(loss.detach())
