"""What the network learns and when (sections 3.4.2, 3.4.3, 3.5.3): step, fit, target rule."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor
from torch.optim.rmsprop import rmsprop

from shared.rl.batches import Batches, Mask, Ranks, ResidentBatches
from shared.rl.draws import generator
from shared.rl.engine import arithmetic
from shared.rl.gradients import Gradients, MeanOfWeights
from shared.rl.memory import SampleStore
from shared.rl.network import QNetwork, initialised
from shared.rl.schedule import Moment, due

if TYPE_CHECKING:
    from shared.config import LearningConfig, NetworkConfig, Numerics


@dataclass(frozen=True)
class Trained:
    """One mini-batch done. epoch and batches count the running fitting phase, 0 outside one."""

    loss: float | None
    """None where it is not known yet: a fitting phase on a GPU tells the mean of all at its end."""
    epoch: int
    batch: int
    batches: int


class Trainer:
    """The train network with its optimiser, and the target network copied from it (E4)."""

    def __init__(
        self, network: NetworkConfig, learning: LearningConfig, numerics: Numerics, seed: int
    ) -> None:
        self._learning, self._numerics, self._seed = learning, numerics, seed
        self.train_network = initialised(network, seed).to(numerics.device)
        self.target_network = QNetwork(network).to(numerics.device)
        self.target_network.load_state_dict(self.train_network.state_dict())
        self.target_network.requires_grad_(False)
        self._parameters: list[Tensor] = list(self.train_network.parameters())
        self._squares = [torch.zeros_like(parameter) for parameter in self._parameters]
        """State of RMSprop: moving averages of the squared gradients, one for each parameter."""
        self._steps = [torch.zeros(()) for _ in self._parameters]
        """RMSprop counts its steps here. Nothing depends on them."""
        self.gradients = Gradients(self.train_network, numerics)
        self._mean = MeanOfWeights(self.train_network)
        """It begins anew with each epoch and each episode."""
        self.train_steps = 0
        self.fits = 0
        self.version = 1
        """The version of the target network; 1 is the initial one."""
        self.steps_at_copy = 0
        self.episode_at_copy = 0

    def configure(self, learning: LearningConfig) -> None:
        """Go on with another schedule, target rule or rate. Call between episodes."""
        self._learning = learning

    def learn(self, samples: SampleStore, now: Moment) -> Iterator[Trained]:
        """Everything learnt after one episode (E25), a fit when due. Yields after a mini-batch."""
        self._mean.restart()
        if not len(samples):
            return
        learning = self._learning
        first = learning.fit_after_fill and now.episode == 1
        if first or due(now, learning.fit_every, learning.fit_every_actions):
            yield from self._fit(samples, now.episode)
        else:
            yield from self._mini_batches(samples, now.episode)

    def fit_batches(self, samples: int) -> int:
        """Mini-batches of a whole fitting phase over this number of samples."""
        return self._learning.fit_epochs * -(-samples // self._learning.batch_size)

    def apply_target_rule(self, episode: int, bump: bool) -> bool:
        """Copy train to target where the rule says so (A26, E15); True if the target changed."""
        if self._learning.target_rule == "bump" and not bump:
            return False
        self.episode_at_copy = episode
        if self.train_steps == self.steps_at_copy:
            return False
        self.target_network.load_state_dict(self.train_network.state_dict())
        self._mean.copy_to(self.target_network)
        self.steps_at_copy = self.train_steps
        self.version += 1
        return True

    def step(self, samples: SampleStore, ranks: Ranks, mirrored: Mask | None = None) -> float:
        """One RMSprop step on the mean squared error of the unclipped output (Eq 3.4, E8).

        mirrored: bool [k], which samples to look at in a mirror. Returns the loss; raises
        FloatingPointError when it is not finite, leaving the weights as they were.
        """
        batches = Batches(samples, self._numerics.device)
        loss = self._finite([self.gradients.compute(batches, ranks, mirrored)])
        self._descend()
        return loss

    def tensors(self) -> dict[str, Tensor]:
        """All tensors of the state, by name, for a checkpoint."""
        state: dict[str, Tensor] = {}
        for role, network in (("train", self.train_network), ("target", self.target_network)):
            state |= {f"{role}.{name}": t.detach() for name, t in network.state_dict().items()}
        return state | dict(zip(self._square_names(), self._squares, strict=True))

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
        for name, square in zip(self._square_names(), self._squares, strict=True):
            _copy_checked(square, tensors[name], name)

    def _square_names(self) -> Iterator[str]:
        """Yield the names of the optimiser's tensors in a checkpoint."""
        for name, _ in self.train_network.named_parameters():
            yield f"square_avg.{name}"

    def _mini_batches(self, samples: SampleStore, episode: int) -> Iterator[Trained]:
        """Mini-batches without replacement, drawn by rank of insertion number (E30)."""
        size = min(self._learning.batch_size, len(samples))
        for batch in range(self._learning.mini_batches_per_episode):
            draw = generator(self._seed, "mini-batch", episode, batch)
            ranks = draw.choice(len(samples), size=size, replace=False)
            yield Trained(self.step(samples, ranks, self._mirrored(draw, size)), 0, batch + 1, 0)

    def _fit(self, samples: SampleStore, episode: int) -> Iterator[Trained]:
        """A36: epochs of shuffled mini-batches, the last, partial one included (E30)."""
        deferred, unread = self.gradients.deferred, list[Tensor]()
        kind = ResidentBatches if deferred else Batches
        batches, count = kind(samples, self._numerics.device), self.fit_batches(len(samples))
        for done, (epoch, ranks, mirrored) in enumerate(self._shuffled(len(samples), episode), 1):
            unread.append(self.gradients.compute(batches, ranks, mirrored))
            loss = None
            if not deferred or done == count:
                loss, unread = self._finite(unread), []
            self._descend()
            yield Trained(loss, epoch + 1, done, count)
        self.fits += 1

    def _shuffled(self, count: int, episode: int) -> Iterator[tuple[int, Ranks, Mask | None]]:
        """Every mini-batch of a fitting phase with its epoch, and what of it to mirror."""
        for epoch in range(self._learning.fit_epochs):
            self._mean.restart()
            draw = generator(self._seed, "fit", episode, epoch)
            order = draw.permutation(count)
            for start in range(0, count, self._learning.batch_size):
                ranks = order[start : start + self._learning.batch_size]
                yield epoch, ranks, self._mirrored(draw, len(ranks))

    def _mirrored(self, draw: np.random.Generator, count: int) -> Mask | None:
        """Which samples of a mini-batch to look at in a mirror: by chance, half of them."""
        return draw.random(count) < 0.5 if self._learning.augmentation == "mirror" else None

    def _finite(self, losses: list[Tensor]) -> float:
        """The mean of these losses. Raises FloatingPointError when it is not finite."""
        loss = float(torch.stack(losses).mean())
        if not math.isfinite(loss):
            raise FloatingPointError(f"loss is {loss} at training step {self.train_steps}")
        return loss

    @torch.no_grad()
    def _descend(self) -> None:
        """Let RMSprop change the weights by the newest gradient (A25, E30).

        The function, and not `torch.optim.RMSprop`: the class imports a compiler, for a second.
        """
        learning = self._learning
        with arithmetic(self._numerics):
            rmsprop(
                self._parameters,
                [parameter.grad for parameter in self._parameters if parameter.grad is not None],
                self._squares,
                [],
                [],
                self._steps,
                lr=learning.learning_rate,
                alpha=learning.rmsprop_alpha,
                eps=learning.rmsprop_epsilon,
                weight_decay=0.0,
                momentum=0.0,
                centered=False,
            )
            if learning.target_average:
                self._mean.take()
        self.train_steps += 1


def _copy_checked(own: Tensor, given: Tensor, name: str) -> None:
    if given.shape != own.shape or given.dtype != own.dtype:
        raise ValueError(
            f"{name}: expected {own.dtype} {list(own.shape)}, got {given.dtype} {list(given.shape)}"
        )
    own.copy_(given)
