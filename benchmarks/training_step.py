"""P1: how much faster is one training step of 128 images than plain PyTorch?"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt
import torch

from benchmarks import frames, plain
from benchmarks.frame import (
    Mode,
    Times,
    interleaved,
    mode_of,
    report,
    rounds_of,
    speedup,
    times_table,
)
from benchmarks.frame import table as as_table
from shared.config import Config, LearnerNumerics, LearningConfig, Numerics
from shared.numerics import choose
from shared.provenance import ROOT
from shared.rl.learning import Trainer
from shared.rl.network import QNetwork, load_bytes

REQUIRED, AIM = 4.0, 6.0
MINI_BATCH = 128
PARTS = (4, 8, 16, 32)
KEPT = """Much of the plain step's time goes into fresh memory, which the C library returns after
every large operation. With that turned off it takes {:.0f} ms (threads: {})."""
TUNABLES = "glibc.malloc.mmap_max=0:glibc.malloc.trim_threshold=4294967296"
PLAIN = """
import json, sys
from functools import partial
from statistics import median
from benchmarks import frames, plain
from benchmarks.frame import interleaved
from benchmarks.training_step import mini_batch
from shared.config import LearningConfig
mode, threads, rounds = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
step = plain.Step(
    frames.network_config(mode), LearningConfig(), frames.trained_weights(mode), threads
)
times = interleaved({"plain": partial(step, frames.samples(mode), mini_batch(mode))}, rounds)
print(json.dumps(median(times["plain"]) * 1e3))
"""
Ranks = npt.NDArray[np.int64]


def main(arguments: Sequence[str] | None = None) -> None:
    mode = mode_of(arguments, __doc__)
    chosen = settled(mode)
    cosines = gradient_cosines(mode)
    times, tables = measure(mode, chosen)
    rows = [[*case, f"{value:.7f}"] for case, value in cosines.items()]
    kept_ms = plain_with_kept_memory_ms(mode, chosen.threads)
    tables.append(KEPT.format(kept_ms, chosen.threads))
    tables.append(as_table(["gradient", "weights", "worst cosine with plain float32"], rows))
    bar = speedup("P1", times["plain"], times[label(chosen)], REQUIRED, AIM)
    checks = {"threads": float(chosen.threads), "plain_with_kept_memory_ms": kept_ms}
    for weights in ("trained", "untrained"):
        checks[f"gradient_cosine_{weights}"] = cosines[chosen.precision, weights]
    report("P1 training step", tables, [replace(bar, checks=checks)])


def settled(mode: Mode) -> Numerics:
    """What the learner chooses here when threads and precision are left open."""
    if mode == "check":
        return LearnerNumerics()
    config = Config(network=frames.network_config(mode))
    return choose(config, LearnerNumerics(threads=0, precision="auto"), "learner")


def label(numerics: Numerics) -> str:
    return f"{numerics.precision}, parts of {numerics.batch}"


def measure(mode: Mode, chosen: Numerics) -> tuple[Times, list[str]]:
    """Times with as many threads as the learner chooses, and a table for each count of threads."""
    rounds = rounds_of(mode, short=3, full=15)
    tables, of_chosen = [], Times()
    for threads in (1,) if mode == "check" else sorted({1, 2, chosen.threads}):
        times = interleaved(cases(mode, threads), rounds)
        tables.append(f"threads: {threads}\n\n{times_table(times, 'plain')}")
        if threads == chosen.threads:
            of_chosen = times
    return of_chosen, tables


def plain_with_kept_memory_ms(mode: Mode, threads: int) -> float:
    """Median of the plain step in a process whose C library keeps freed memory (Linux)."""
    rounds = str(rounds_of(mode, short=3, full=15))
    command = [sys.executable, "-c", PLAIN, mode, str(threads), rounds]
    environment = {**os.environ, "GLIBC_TUNABLES": TUNABLES}
    done = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, env=environment)
    return float(json.loads(done.stdout.splitlines()[-1]))


def cases(mode: Mode, threads: int) -> dict[str, Callable[[], object]]:
    """The plain step, and ours in both precisions and several part sizes."""
    store, ranks = frames.samples(mode), mini_batch(mode)
    config, learning = frames.network_config(mode), LearningConfig()
    weights = frames.trained_weights(mode)
    naive = plain.Step(config, learning, weights, threads)
    found: dict[str, Callable[[], object]] = {"plain": partial(naive, store, ranks)}
    for precision in ("float32", "bfloat16"):
        for part in PARTS[1:2] if mode == "check" else PARTS:
            numerics = LearnerNumerics(threads=threads, precision=precision, batch=part)
            trainer = Trainer(config, learning, numerics, frames.SEED)
            load_bytes(trainer.train_network, weights)
            found[label(numerics)] = partial(trainer.step, store, ranks)
    return found


def gradient_cosines(mode: Mode) -> dict[tuple[str, str], float]:
    """Worst cosine of the whole gradient with the plain step's, by precision and weights."""
    draws, cosines = rounds_of(mode, short=2, full=10), {}
    for weights, data in (
        ("trained", frames.trained_weights(mode)),
        ("untrained", frames.untrained_weights(mode)),
    ):
        for precision in ("float32", "bfloat16"):
            found = [cosine(mode, precision, data, mini_batch(mode, i)) for i in range(draws)]
            cosines[precision, weights] = min(found)
        found = [autocast_cosine(mode, data, mini_batch(mode, i)) for i in range(draws)]
        cosines["bfloat16 forward too", weights] = min(found)
    return cosines


def autocast_cosine(mode: Mode, weights: bytes, ranks: Ranks) -> float:
    """Cosine of the gradient that PyTorch's autocast gives: what training in bfloat16 would be."""
    config = frames.network_config(mode)
    exact = plain.Step(config, LearningConfig(), weights, threads=1)
    rounded = plain.Step(config, LearningConfig(), weights, threads=1)
    exact(frames.samples(mode), ranks)
    with torch.autocast("cpu", torch.bfloat16):
        rounded(frames.samples(mode), ranks)
    return between(gradient(exact.network), gradient(rounded.network))


def cosine(mode: Mode, precision: str, weights: bytes, ranks: Ranks) -> float:
    """Cosine between our gradient of a mini-batch of real frames and the plain step's."""
    store, config = frames.samples(mode), frames.network_config(mode)
    naive = plain.Step(config, LearningConfig(), weights, threads=1)
    numerics = LearnerNumerics.model_validate({"precision": precision})
    trainer = Trainer(config, LearningConfig(), numerics, frames.SEED)
    load_bytes(trainer.train_network, weights)
    naive(store, ranks)
    trainer.step(store, ranks)
    return between(gradient(naive.network), gradient(trainer.train_network))


def between(one: torch.Tensor, other: torch.Tensor) -> float:
    """The cosine of two vectors."""
    return float(one @ other / (one.norm() * other.norm()))


def mini_batch(mode: Mode, number: int = 0) -> Ranks:
    """Ranks of 128 frames drawn at random, as in training."""
    draw = np.random.default_rng([frames.SEED, number])
    return draw.choice(frames.SIZES[mode].frames, MINI_BATCH, replace=False)


def gradient(network: QNetwork) -> torch.Tensor:
    """All gradients of the last step as one vector of float64."""
    parts = [p.grad.flatten().double() for p in network.parameters() if p.grad is not None]
    return torch.cat(parts)


if __name__ == "__main__":
    main()
