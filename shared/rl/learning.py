"""Training step, fitting phase and target rule (sections 3.4.2, 3.4.3, 3.5.3)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from shared.rl.draws import generator
from shared.rl.equalisation import due
from shared.rl.memory import SampleStore
from shared.rl.network import QNetwork, initialised
from shared.rl.predictor import arithmetic, feature_maps, network_input

if TYPE_CHECKING:
    from shared.config import LearningConfig, NetworkConfig, Numerics

Ranks = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Trained:
    """One mini-batch done. epoch and batches count the running fitting phase, 0 outside one."""

    loss: float
    epoch: int
    batch: int
    batches: int


class Trainer:
    """The train network with its optimiser, and the target network copied from it.

    The two are named by role, never by symbol (E4). Only target versions leave the learner.
    """

    def __init__(
        self, network: NetworkConfig, learning: LearningConfig, numerics: Numerics, seed: int
    ) -> None:
        self._learning, self._numerics, self._seed = learning, numerics, seed
        self.train_network = initialised(network, seed).to(numerics.device)
        self.target_network = QNetwork(network).to(numerics.device)
        self.target_network.load_state_dict(self.train_network.state_dict())
        self.target_network.requires_grad_(False)
        self._optimiser = torch.optim.RMSprop(
            self.train_network.parameters(),
            lr=learning.learning_rate,
            alpha=learning.rmsprop_alpha,
            eps=learning.rmsprop_epsilon,
        )
        self.train_steps = 0
        self.fits = 0
        self.version = 1
        """Of the target network; 1 is the initial one."""
        self.steps_at_copy = 0
        self.episode_at_copy = 0

    def learn(self, samples: SampleStore, episode: int) -> Iterator[Trained]:
        """Everything the network learns at one episode (E25); yields after each mini-batch.

        A fitting phase when due, else `mini_batches_per_episode` steps.
        """
        if not len(samples):
            return
        if due(episode, self._learning.fit_every):
            yield from self._fit(samples, episode)
        else:
            yield from self._mini_batches(samples, episode)

    def fit_batches(self, samples: int) -> int:
        """Mini-batches of a whole fitting phase over so many samples."""
        return self._learning.fit_epochs * -(-samples // self._learning.batch_size)

    def apply_target_rule(self, episode: int, bump: bool) -> bool:
        """Copy train to target where the rule says so (A26, E15); True if the target changed."""
        if self._learning.target_rule == "bump" and not bump:
            return False
        self.episode_at_copy = episode
        if self.train_steps == self.steps_at_copy:
            return False
        self.target_network.load_state_dict(self.train_network.state_dict())
        self.steps_at_copy = self.train_steps
        self.version += 1
        return True

    def step(self, samples: SampleStore, ranks: Ranks) -> float:
        """One RMSprop step on the mean squared error of the unclipped output (Eq 3.4, E8).

        The gradient of a mini-batch is gathered over parts of `numerics.batch` images. Returns the
        loss; raises FloatingPointError when it is not finite, leaving the weights as they were.
        """
        device, part = self._numerics.device, self._numerics.batch
        loss = 0.0
        self._optimiser.zero_grad(set_to_none=True)
        with arithmetic(self._numerics):
            for start in range(0, len(ranks), part):
                some = ranks[start : start + part]
                images = network_input(samples.images(some), device)
                actions = _tensor(samples.rows["action"][some].astype(np.int64), device)
                rewards = _tensor(samples.rows["reward"][some], device)
                maps = feature_maps(self.train_network, images, self._numerics)
                values = self.train_network.values(maps, actions)
                error = (rewards - values).square().sum() / len(ranks)
                torch.autograd.backward(error)
                loss += float(error.detach())
            if not np.isfinite(loss):
                raise FloatingPointError(f"loss is {loss} at training step {self.train_steps}")
            self._optimiser.step()
        self.train_steps += 1
        return loss

    def tensors(self) -> dict[str, Tensor]:
        """All tensors of the state, by name, for a checkpoint."""
        state: dict[str, Tensor] = {}
        for role, network in (("train", self.train_network), ("target", self.target_network)):
            state |= {f"{role}.{name}": t.detach() for name, t in network.state_dict().items()}
        for name, parameter in self.train_network.named_parameters():
            moments = self._optimiser.state.get(parameter)
            square = moments["square_avg"] if moments else torch.zeros_like(parameter)
            state[f"square_avg.{name}"] = square.detach()
        return state

    def counters(self) -> dict[str, int]:
        """All counters of the state, for a checkpoint."""
        names = ("train_steps", "fits", "version", "steps_at_copy", "episode_at_copy")
        return {name: getattr(self, name) for name in names}

    def restore(self, tensors: dict[str, Tensor], counters: dict[str, int]) -> None:
        """Continue from `tensors()` and `counters()`. Raises KeyError or ValueError on a misfit."""
        for name in self.counters():
            setattr(self, name, int(counters[name]))
        with torch.no_grad():
            for role, network in (("train", self.train_network), ("target", self.target_network)):
                for name, own in network.named_parameters():
                    _copy_checked(own, tensors[f"{role}.{name}"], f"{role}.{name}")
        for name, parameter in self.train_network.named_parameters():
            square = torch.zeros_like(parameter)
            _copy_checked(square, tensors[f"square_avg.{name}"], f"square_avg.{name}")
            self._optimiser.state[parameter] = {
                "step": torch.tensor(float(self.train_steps)),
                "square_avg": square,
            }

    def _mini_batches(self, samples: SampleStore, episode: int) -> Iterator[Trained]:
        """Mini-batches without replacement, drawn by rank of insertion number (E30)."""
        size = min(self._learning.batch_size, len(samples))
        for batch in range(self._learning.mini_batches_per_episode):
            draw = generator(self._seed, "mini-batch", episode, batch)
            ranks = draw.choice(len(samples), size=size, replace=False)
            yield Trained(self.step(samples, ranks), 0, batch + 1, 0)

    def _fit(self, samples: SampleStore, episode: int) -> Iterator[Trained]:
        """A36: epochs of shuffled mini-batches, the last, partial one included (E30)."""
        batches, done = self.fit_batches(len(samples)), 0
        for epoch in range(self._learning.fit_epochs):
            order = generator(self._seed, "fit", episode, epoch).permutation(len(samples))
            for start in range(0, len(order), self._learning.batch_size):
                done += 1
                loss = self.step(samples, order[start : start + self._learning.batch_size])
                yield Trained(loss, epoch + 1, done, batches)
        self.fits += 1


def _tensor(values: npt.NDArray[np.generic], device: str) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values)).to(device)


def _copy_checked(own: Tensor, given: Tensor, name: str) -> None:
    if given.shape != own.shape or given.dtype != own.dtype:
        raise ValueError(
            f"{name}: expected {own.dtype} {list(own.shape)}, got {given.dtype} {list(given.shape)}"
        )
    own.copy_(given)
