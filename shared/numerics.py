"""Settling what a run leaves to be chosen: threads and precision of each role, by measurement.

Chosen once, when the run first starts, and then fixed in its folder: arithmetic is part of what a
run is, and a resumed run must compute the same bits.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from typing import Literal, get_args

from pydantic import ValidationError

from shared.config import Config, NetworkConfig, Numerics
from shared.errors import StateError
from shared.settings import read_folder
from shared.statefile import write_atomically

Role = Literal["actor", "replay", "learner"]
ROUNDS = 5
WORTHWHILE = 0.8
"""bfloat16 must take at most this part of float32's time to be chosen."""


def settle(config: Config, folder: Path, role: Role) -> Numerics:
    """The settled numerics of one role in this run folder; chooses and stores them at first use.

    Raises StateError when the stored ones are damaged.
    """
    wanted: Numerics = getattr(config.numerics, role)
    if wanted.settled:
        return wanted
    path = folder / "numerics" / f"{role}.json"
    if path.exists():
        try:
            return type(wanted).model_validate(json.loads(path.read_text()))
        except ValidationError as error:
            raise StateError(f"{path}: damaged: {error.errors()[0]['msg']}") from error
        except ValueError as error:
            raise StateError(f"{path}: damaged: {error}") from error
    chosen = choose(config, wanted, role)
    write_atomically(path, (json.dumps(chosen.model_dump(), indent=1) + "\n").encode())
    return chosen


def settle_all(config: Config, folder: Path) -> None:
    """Settle every role now, while nothing else runs that could disturb the measurement.

    In a process of its own: who calls this needs no torch afterwards. Raises StateError.
    """
    roles = [role for role in get_args(Role) if not getattr(config.numerics, role).settled]
    command = [sys.executable, "-m", "shared.numerics", str(folder), *roles]
    if roles and subprocess.run(command, check=False).returncode:
        raise StateError(f"{folder}: threads and precision could not be settled, see above")


def choose(config: Config, wanted: Numerics, role: Role) -> Numerics:
    """Fill in what is left open.

    Threads: while the learner trains synchronously nobody else works, so it takes all cores (at
    most 8), and so does replay for its passes; everything else stays with one, because two busy
    processes that share cores slow each other down far more than a second thread helps.
    """
    threads = wanted.threads
    if not threads:
        alone = config.learning.mode == "synchronous" and role != "actor"
        threads = min(len(os.sched_getaffinity(0)), 8) if alone else 1
    settled = wanted.model_copy(update={"threads": threads, "precision": "float32"})
    if wanted.precision == "auto":
        reduced = settled.model_copy(update={"precision": "bfloat16"})
        if _seconds(config.network, settled, reduced) < WORTHWHILE:
            settled = reduced
    elif wanted.precision == "bfloat16":
        settled = settled.model_copy(update={"precision": "bfloat16"})
    return settled


def _seconds(network: NetworkConfig, plain: Numerics, reduced: Numerics) -> float:
    """Time of one pass in reduced precision over that in plain, medians of interleaved rounds."""
    import numpy as np

    from shared.rl.network import initialised, to_bytes
    from shared.rl.predictor import Predictor

    data = to_bytes(initialised(network, seed=0))
    images = np.zeros((plain.batch, 50, 75), np.uint8)
    predictors = [Predictor(network, numerics) for numerics in (plain, reduced)]
    times: tuple[list[float], list[float]] = ([], [])
    for predictor in predictors:
        predictor.load(1, data)
        predictor.all_values(images)
    for _ in range(ROUNDS):
        for predictor, spent in zip(predictors, times, strict=True):
            start_s = time.perf_counter()
            predictor.all_values(images)
            spent.append(time.perf_counter() - start_s)
    return median(times[1]) / median(times[0])


def main(folder: str, *roles: str) -> None:
    """Settle some roles of the run in `folder`."""
    config = read_folder(Path(folder))
    for role in get_args(Role):
        if role in roles:
            settle(config, Path(folder), role)


if __name__ == "__main__":
    main(*sys.argv[1:])
