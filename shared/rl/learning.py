"""Training step, fitting phase and target rule (sections 3.4.2, 3.4.3, 3.5.3)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from shared.rl import trunk
from shared.rl.batches import Batches, Mask, Ranks, ResidentBatches, StoredBatches
from shared.rl.draws import generator
from shared.rl.engine import arithmetic, scaled
from shared.rl.equalisation import due
from shared.rl.memory import SampleStore
from shared.rl.network import QNetwork, initialised

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
        self._in_a_share = numerics.model_copy(update={"threads": 1})
        self._pool = ThreadPoolExecutor(max(1, numerics.threads), "share of a mini-batch")
        self._mean: list[Tensor] = []
        self._in_mean = 0
        """Of the weights after so many steps; begins anew with each epoch and each episode."""
        self.train_steps = 0
        self.fits = 0
        self.version = 1
        """Of the target network; 1 is the initial one."""
        self.steps_at_copy = 0
        self.episode_at_copy = 0

    def configure(self, learning: LearningConfig) -> None:
        """Go on with another schedule, target rule or rate. Call between episodes."""
        self._learning = learning
        for group in self._optimiser.param_groups:
            group["lr"] = learning.learning_rate

    def learn(self, samples: SampleStore, episode: int) -> Iterator[Trained]:
        """Everything the network learns at one episode (E25); yields after each mini-batch.

        A fitting phase when due, else `mini_batches_per_episode` steps.
        """
        self._in_mean = 0
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
        if self._in_mean:
            for own, mean in zip(self.target_network.parameters(), self._mean, strict=True):
                own.copy_(mean)
        self.steps_at_copy = self.train_steps
        self.version += 1
        return True

    def step(self, samples: SampleStore, ranks: Ranks, mirrored: Mask | None = None) -> float:
        """One RMSprop step on the mean squared error of the unclipped output (Eq 3.4, E8).

        mirrored: bool [k], which samples to look at in a mirror. Returns the loss; raises
        FloatingPointError when it is not finite, leaving the weights as they were.
        """
        batches = StoredBatches(samples, self._numerics.device)
        loss = self._checked(float(self._set_gradients(batches, ranks, mirrored)))
        self._apply_gradients()
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
            yield Trained(self.step(samples, ranks, self._mirrored(draw, size)), 0, batch + 1, 0)

    def _fit(self, samples: SampleStore, episode: int) -> Iterator[Trained]:
        """A36: epochs of shuffled mini-batches, the last, partial one included (E30)."""
        deferred = self._numerics.device != "cpu"
        steps = self._deferred_steps if deferred else self._steps
        batches = self.fit_batches(len(samples))
        for done, (epoch, loss) in enumerate(steps(samples, episode), 1):
            yield Trained(loss, epoch + 1, done, batches)
        self.fits += 1

    def _steps(self, samples: SampleStore, episode: int) -> Iterator[tuple[int, float | None]]:
        """The steps of a fitting phase: the epoch each belongs to, and its loss."""
        for epoch, ranks, mirrored in self._shuffled(len(samples), episode):
            yield epoch, self.step(samples, ranks, mirrored)

    def _deferred_steps(
        self, samples: SampleStore, episode: int
    ) -> Iterator[tuple[int, float | None]]:
        """The same without ever waiting for the device: the losses are read at the end.

        Samples are copied to the device once. Raises FloatingPointError after the last step when
        a loss was not finite; the weights are useless then.
        """
        batches, losses = ResidentBatches(samples, self._numerics.device), []
        last = self.fit_batches(len(samples))
        for epoch, ranks, mirrored in self._shuffled(len(samples), episode):
            losses.append(self._set_gradients(batches, ranks, mirrored))
            self._apply_gradients()
            ended = len(losses) == last
            yield epoch, self._checked(float(torch.stack(losses).mean())) if ended else None

    def _shuffled(self, count: int, episode: int) -> Iterator[tuple[int, Ranks, Mask | None]]:
        for epoch in range(self._learning.fit_epochs):
            self._in_mean = 0
            draw = generator(self._seed, "fit", episode, epoch)
            order = draw.permutation(count)
            for start in range(0, count, self._learning.batch_size):
                ranks = order[start : start + self._learning.batch_size]
                yield epoch, ranks, self._mirrored(draw, len(ranks))

    def _mirrored(self, draw: np.random.Generator, count: int) -> Mask | None:
        """Which samples of a mini-batch to look at in a mirror: by chance, half of them."""
        return draw.random(count) < 0.5 if self._learning.augmentation == "mirror" else None

    def _set_gradients(
        self, batches: Batches, ranks: Ranks, mirrored: Mask | None = None
    ) -> Tensor:
        """Put the gradient of a mini-batch where the optimiser looks; returns the loss.

        Each thread takes one share of the mini-batch, and the shares are added up in order: the
        result depends on the number of threads, never on how they run. Threads that wait for each
        other after every operation would be slower, and hopeless beside another busy process.
        """
        size = -(-len(ranks) // self._numerics.threads)
        shares = [slice(start, start + size) for start in range(0, len(ranks), size)]

        def share(part: slice) -> tuple[Tensor, ...]:
            some = None if mirrored is None else mirrored[part]
            return self._share(batches, ranks[part], some, len(ranks))

        work = [self._pool.submit(share, part) for part in shares[1:]]
        loss, *gradients = share(shares[0])
        others = [each.result() for each in work]
        for more, *further in others:
            loss = loss + more
            for own, other in zip(gradients, further, strict=True):
                own.add_(other)
        for parameter, gradient in zip(self.train_network.parameters(), gradients, strict=True):
            parameter.grad = gradient
        return loss

    def _share(
        self, batches: Batches, ranks: Ranks, mirrored: Mask | None, count: int
    ) -> tuple[Tensor, ...]:
        """Loss and gradients of one share of a mini-batch of `count`."""
        network, part = self.train_network, self._numerics.images_per_pass
        reduced = self._numerics.precision == "bfloat16"
        with arithmetic(self._in_a_share):
            batch = batches.take(ranks)
            if mirrored is not None:
                batch = batch.mirrored(torch.from_numpy(mirrored).to(batch.actions.device))
            parts = [scaled(some) for some in batch.images.split(part)]  # type: ignore[no-untyped-call]
            maps = [trunk.maps(network, p) if reduced else network.maps(p) for p in parts]
            error = batch.rewards - network.values(torch.cat(maps), batch.actions)
            loss = error.square().sum() / count
            return loss.detach(), *torch.autograd.grad(loss, list(network.parameters()))

    def _apply_gradients(self) -> None:
        with arithmetic(self._numerics):
            self._optimiser.step()
            if self._learning.target_average:
                self._take_into_mean()
        self.train_steps += 1

    @torch.no_grad()
    def _take_into_mean(self) -> None:
        weights = [parameter.detach() for parameter in self.train_network.parameters()]
        self._in_mean += 1
        if self._in_mean == 1:
            self._mean = [weight.clone() for weight in weights]
        else:
            for mean, weight in zip(self._mean, weights, strict=True):
                mean.lerp_(weight, 1.0 / self._in_mean)

    def _checked(self, loss: float) -> float:
        """Raise FloatingPointError for a loss that is not finite."""
        if not math.isfinite(loss):
            raise FloatingPointError(f"loss is {loss} at training step {self.train_steps}")
        return loss


def _copy_checked(own: Tensor, given: Tensor, name: str) -> None:
    if given.shape != own.shape or given.dtype != own.dtype:
        raise ValueError(
            f"{name}: expected {own.dtype} {list(own.shape)}, got {given.dtype} {list(given.shape)}"
        )
    own.copy_(given)
