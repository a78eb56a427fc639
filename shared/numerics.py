"""Settling what a run leaves to be chosen: how each role computes here, by measurement.

Chosen once, when the run first starts, and then fixed in its folder: arithmetic is part of what a
run is, and a resumed run must compute the same bits.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Literal, get_args

import numpy as np
from pydantic import ValidationError

from shared.config import Config, Numerics
from shared.errors import ConfigError, StateError
from shared.facts import IMAGE_SHAPE
from shared.settings import read_folder
from shared.statefile import create

Role = Literal["actor", "replay", "learner"]
WARM_UP, ROUNDS = 2, 5
WORTHWHILE = 0.8
"""What is not plain must take less than this part of the plain way's time to be chosen."""


def settle(config: Config, folder: Path, role: Role, common: Path | None = None) -> Numerics:
    """The settled numerics of one role in this run folder; chooses and stores them at first use.

    common: a folder where runs that are to compute alike share what the first of them chose.

    Raises StateError when the stored ones are damaged, ConfigError when they name what is missing.
    """
    wanted: Numerics = getattr(config.numerics, role)
    if wanted.settled:
        return _installed(wanted)
    path = folder / "numerics" / f"{role}.json"
    if path.exists():
        try:
            return _installed(type(wanted).model_validate(json.loads(path.read_text())))
        except ValidationError as error:
            raise StateError(f"{path}: damaged: {error.errors()[0]['msg']}") from error
        except ValueError as error:
            raise StateError(f"{path}: damaged: {error}") from error
    chosen = settle(config, common, role) if common else choose(config, wanted, role)
    create(path, (json.dumps(chosen.model_dump(), indent=1) + "\n").encode())
    return settle(config, folder, role)  # another process may have been faster


def settle_all(config: Config, folder: Path) -> None:
    """Settle every role now, while nothing else runs that could disturb the measurement.

    In a process of its own: who calls this needs no torch afterwards. Raises StateError.
    """
    roles = [role for role in get_args(Role) if not getattr(config.numerics, role).settled]
    command = [sys.executable, "-m", "shared.numerics", str(folder), *roles]
    if roles and subprocess.run(command, check=False).returncode:
        raise StateError(f"{folder}: numerics could not be settled, see above")


def choose(config: Config, wanted: Numerics, role: Role) -> Numerics:
    """Fill in what is left open. Raises ConfigError for what this machine does not have.

    Threads: while the learner trains synchronously nobody else works, so it takes all cores (at
    most 8), and so does replay for its passes; everything else stays with one, because two busy
    processes that share cores slow each other down far more than a second thread helps, and a GPU
    is fed by one.
    """
    threads, device = wanted.threads, wanted.device
    if device == "auto":
        device = "cuda" if _has_gpu() else "cpu"
    if not threads:
        alone = config.learning.mode == "synchronous" and role != "actor"
        threads = min(len(os.sched_getaffinity(0)), 8) if alone and device == "cpu" else 1
    placed = _installed(wanted.model_copy(update={"threads": threads, "device": device}))
    candidates = _candidates(placed)
    if len(candidates) == 1:
        return candidates[0]
    times = _seconds(config, candidates, role)
    return _fastest(candidates, times)


def _candidates(placed: Numerics) -> list[Numerics]:
    """Every way to settle engine and precision, the plainest first."""
    engines = [placed.engine]
    if placed.engine == "auto":
        on_cpu = placed.device == "cpu" and _has_openvino()
        engines = ["torch", "openvino"] if on_cpu else ["torch"]
    precisions = ["float32", "bfloat16"] if placed.precision == "auto" else [placed.precision]
    return [
        placed.model_copy(update={"engine": engine, "precision": precision})
        for precision in precisions
        for engine in engines
    ]


def _fastest(candidates: Sequence[Numerics], times: Sequence[float]) -> Numerics:
    """The first candidate unless another takes much less of its time: then the fastest."""
    best = min(range(len(times)), key=times.__getitem__)
    return candidates[best] if times[best] < WORTHWHILE * times[0] else candidates[0]


def _installed(wanted: Numerics) -> Numerics:
    """The same numerics. Raises ConfigError when they name an engine that is not installed."""
    if wanted.engine == "openvino" and not _has_openvino():
        raise ConfigError(
            "numerics: engine 'openvino' is not installed here: install corridor[openvino], or "
            "set engine to 'torch'"
        )
    return wanted


def _has_gpu() -> bool:
    import torch

    return torch.cuda.is_available()


def _has_openvino() -> bool:
    return importlib.util.find_spec("openvino") is not None


def _seconds(config: Config, candidates: Sequence[Numerics], role: Role) -> list[float]:
    """Time of the role's work under each candidate, medians of interleaved rounds."""
    work = [(_training if role == "learner" else _predicting)(config, each) for each in candidates]
    times: list[list[float]] = [[] for _ in work]
    for number in range(WARM_UP + ROUNDS):
        for do, spent in zip(work, times, strict=True):
            start_s = time.perf_counter()
            do()
            if number >= WARM_UP:
                spent.append(time.perf_counter() - start_s)
    return [median(spent) for spent in times]


def _predicting(config: Config, numerics: Numerics) -> Callable[[], object]:
    """One pass of a predictor."""
    from shared.rl.network import initialised, to_bytes
    from shared.rl.predictor import Predictor

    predictor = Predictor(config.network, numerics)
    predictor.load(1, to_bytes(initialised(config.network, seed=0)))
    images = np.zeros((numerics.images_per_pass, *IMAGE_SHAPE), np.uint8)
    return lambda: predictor.all_values(images)


def _training(config: Config, numerics: Numerics) -> Callable[[], object]:
    """One training step."""
    from shared.rl.learning import Trainer
    from shared.rl.memory import MIRROR, SampleStore

    size = config.learning.batch_size
    rows = np.zeros(size, MIRROR)
    rows["id"] = np.arange(1, size + 1)
    samples = SampleStore()
    samples.append(rows, np.zeros((size, *IMAGE_SHAPE), np.uint8))
    trainer = Trainer(config.network, config.learning, numerics, seed=0)
    return lambda: trainer.step(samples, np.arange(size))


def main(folder: str, *roles: str) -> None:
    """Settle some roles of the run in `folder`."""
    config = read_folder(Path(folder))
    for role in get_args(Role):
        if role in roles:
            settle(config, Path(folder), role)


if __name__ == "__main__":
    main(*sys.argv[1:])
