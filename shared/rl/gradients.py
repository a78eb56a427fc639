"""How the gradient of a mini-batch is computed: shares, precision, means of weights."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from shared.rl import trunk
from shared.rl.batches import Batches, Mask, Ranks
from shared.rl.engine import arithmetic, scaled
from shared.rl.network import QNetwork

if TYPE_CHECKING:
    from shared.config import Numerics


class Gradients:
    """Computes losses and gradients of one network, whose parameters get the gradients."""

    def __init__(self, network: QNetwork, numerics: Numerics) -> None:
        self._network, self._numerics = network, numerics
        self._in_a_share = numerics.model_copy(update={"threads": 1})
        self._pool = ThreadPoolExecutor(max(1, numerics.threads), "share of a mini-batch")
        self.deferred = numerics.device != "cpu"
        """Whether a fitting phase never waits for the device: losses are read at its end."""

    def compute(self, batches: Batches, ranks: Ranks, mirrored: Mask | None = None) -> Tensor:
        """Put the gradient of a mini-batch where the optimiser looks; returns the loss.

        Each thread takes one share of the mini-batch, and the shares are added up in order: the
        result depends on the number of threads, never on how they run.
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
        for parameter, gradient in zip(self._network.parameters(), gradients, strict=True):
            parameter.grad = gradient
        return loss

    def _share(
        self, batches: Batches, ranks: Ranks, mirrored: Mask | None, count: int
    ) -> tuple[Tensor, ...]:
        """Loss and gradients of one share of a mini-batch of `count` (Eq 3.4, E8)."""
        network, part = self._network, self._numerics.images_per_pass
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


class MeanOfWeights:
    """The mean of a network's weights after several steps."""

    def __init__(self, network: QNetwork) -> None:
        self._network = network
        self._mean: list[Tensor] = []
        self.count = 0
        """Steps whose weights are in the mean."""

    def restart(self) -> None:
        """Begin a new mean."""
        self.count = 0

    @torch.no_grad()
    def take(self) -> None:
        """Take the weights as they are now into the mean."""
        weights = [parameter.detach() for parameter in self._network.parameters()]
        self.count += 1
        if self.count == 1:
            self._mean = [weight.clone() for weight in weights]
        else:
            for mean, weight in zip(self._mean, weights, strict=True):
                mean.lerp_(weight, 1.0 / self.count)

    def copy_to(self, network: QNetwork) -> None:
        """Let another network have the mean; without any step in it, nothing happens."""
        if self.count:
            for own, mean in zip(network.parameters(), self._mean, strict=True):
                own.copy_(mean)
