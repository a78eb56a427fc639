"""P9: how long a fitting phase and the descriptors of a whole memory take on a GPU.

Ours is what the learner and replay do where `device` is "cuda"; plain is the same network written
down first, moved to the same GPU: float32, mini-batches copied one by one, every loss read. Without
a GPU nothing is measured; with --check the same code runs on the CPU, on a tiny network.

    python -m benchmarks.gpu [--short | --check]
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from statistics import median
from typing import Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812  (the customary name)

from benchmarks import frames, plain
from benchmarks.frame import (
    Bar,
    Mode,
    interleaved,
    mode_of,
    report,
    rounds_of,
    speedup,
    times_table,
)
from benchmarks.peers import NOT_INSTALLED
from shared.config import LearnerNumerics, LearningConfig, Numerics
from shared.rl.descriptor import block_sums, describe
from shared.rl.learning import Trainer
from shared.rl.memory import MIRROR, SampleStore
from shared.rl.predictor import Predictor
from shared.rl.schedule import Moment

FITTED: dict[Mode, int] = {"check": 40, "short": 45_000, "full": 45_000}
DESCRIBED: dict[Mode, int] = {"check": 40, "short": 90_000, "full": 90_000}
EPISODE = 100
Device = Literal["cpu", "cuda"]


def main(arguments: Sequence[str] | None = None) -> None:
    mode = mode_of(arguments, __doc__)
    if mode != "check" and not torch.cuda.is_available():
        print("P9 is not measured: there is no GPU that torch can use here")
        sys.exit(NOT_INSTALLED)
    device: Device = "cpu" if mode == "check" else "cuda"
    fits, fit_times = compared(fitting_phases(mode, device), mode)
    passes, pass_times = compared(descriptions(mode, device), mode)
    bars = [
        Bar("P9a", fits[1], "s", "lower", 5.0, 2.0, fits[0] * 1e3, fits[1] * 1e3, fits[2]),
        Bar("P9b", passes[1], "s", "lower", 1.0, 0.3, passes[0] * 1e3, passes[1] * 1e3, passes[2]),
        replace(speedup("P9c", fits[:1], fits[1:2], 1.0, 1.0), n=fits[2]),
        replace(speedup("P9d", passes[:1], passes[1:2], 1.0, 1.0), n=passes[2]),
    ]
    report(f"P9 on {name(device)}", [fit_times, pass_times], bars)


def name(device: Device) -> str:
    return torch.cuda.get_device_name() if device == "cuda" else "the CPU, only to see it run"


def compared(
    cases: dict[str, Callable[[], object]], mode: Mode
) -> tuple[tuple[float, float, int], str]:
    """Median seconds of plain and ours and the rounds, and the table."""
    times = interleaved(cases, rounds_of(mode, short=3, full=7))
    spent = median(times["plain"]), median(times["ours"]), len(times["ours"])
    return spent, times_table(times, "plain")


def fitting_phases(mode: Mode, device: Device) -> dict[str, Callable[[], object]]:
    """Three epochs over the memory, plain and ours; both end when the last loss is known."""
    learning, store = LearningConfig(fit_every=EPISODE), filled(mode, FITTED[mode])
    numerics = LearnerNumerics(device=device, precision="bfloat16")
    trainer = Trainer(frames.network_config(mode), learning, numerics, frames.SEED)
    naive = PlainStep(mode, learning, device)

    def plain_phase() -> None:
        for _ in range(learning.fit_epochs):
            order = np.random.default_rng(frames.SEED).permutation(len(store))
            for start in range(0, len(order), learning.batch_size):
                naive(store, order[start : start + learning.batch_size])

    return {"plain": plain_phase, "ours": lambda: list(trainer.learn(store, Moment(EPISODE)))}


def descriptions(mode: Mode, device: Device) -> dict[str, Callable[[], object]]:
    """Descriptors of the memory, plain and ours."""
    images = frames.images(mode, DESCRIBED[mode])
    predictor = Predictor(
        frames.network_config(mode), Numerics(device=device, precision="bfloat16")
    )
    predictor.load(1, frames.trained_weights(mode))
    net = plain.network(frames.network_config(mode), frames.trained_weights(mode)).to(device)

    def plain_pass() -> object:
        sums = []
        with torch.no_grad():
            for start in range(0, len(images), plain.BATCH):
                tensor = on(device, images[start : start + plain.BATCH])
                sums.append(block_sums(net.maps(tensor)).cpu().numpy())
        return describe(np.concatenate(sums))

    return {"plain": plain_pass, "ours": lambda: predictor.descriptors(images)}


class PlainStep:
    """A training step as one writes it down first, on a device."""

    def __init__(self, mode: Mode, learning: LearningConfig, device: Device) -> None:
        self._network = plain.network(frames.network_config(mode), frames.trained_weights(mode))
        self._network.to(device)
        self._device: Device = device
        self._optimiser = torch.optim.RMSprop(
            self._network.parameters(),
            lr=learning.learning_rate,
            alpha=learning.rmsprop_alpha,
            eps=learning.rmsprop_epsilon,
        )

    def __call__(self, store: SampleStore, ranks: np.ndarray) -> float:
        """One step; returns the loss."""
        actions = torch.from_numpy(store.rows["action"][ranks].astype(np.int64)).to(self._device)
        rewards = torch.from_numpy(store.rows["reward"][ranks].astype(np.float32)).to(self._device)
        self._optimiser.zero_grad()
        maps = self._network.maps(on(self._device, store.images(ranks)))
        loss = F.mse_loss(self._network.values(maps, actions), rewards)
        torch.autograd.backward(loss)
        self._optimiser.step()
        return float(loss.detach())


def on(device: Device, images: np.ndarray) -> Tensor:
    """uint8 [n, 50, 75] to float32 [n, 1, 50, 75] in [0, 1] on a device."""
    return plain.tensor(images).to(device)


def filled(mode: Mode, count: int) -> SampleStore:
    """The frames over again until there are so many samples."""
    found = frames.samples(mode)
    ranks = np.arange(count, dtype=np.int64) % len(found)
    rows = np.zeros(count, MIRROR)
    rows["id"] = np.arange(1, count + 1)
    rows["action"], rows["reward"] = found.rows["action"][ranks], found.rows["reward"][ranks]
    store = SampleStore()
    store.append(rows, found.images(ranks))
    return store


if __name__ == "__main__":
    main()
