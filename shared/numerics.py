"""Settling what a run leaves to be chosen: how each role computes here, by measurement.

Chosen once, when the run first starts, and then fixed in its folder: arithmetic is part of what a
run is, and a resumed run must compute the same bits.
"""

import importlib.util
import json
import logging
import os
import re
import select
import signal
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
from shared.errors import ConfigError, StateError, first_problem
from shared.facts import IMAGE_SHAPE
from shared.settings import read_folder
from shared.statefile import create

Role = Literal["actor", "replay", "learner"]
ROLES: tuple[Role, ...] = get_args(Role)
COMMAND = (sys.executable, "-P", "-m", "shared.numerics")
TRYING, TRY_S = "trying ", 180.0
"""How a child names what it tries, and how long one try may take."""
POLL_S, NEWS_S = 0.1, 1.5
"""How often a child is looked at, and how often a line tells what it measures."""
WARM_UP, ROUNDS = 2, 5
WORTHWHILE = 0.8
"""What is not plain must take less than this part of the plain way's time to be chosen."""
log = logging.getLogger(__name__)
_left_out: list[str] | None = None
"""In a child that settles roles: what failed in those before it. None: this is no such child."""


def settle(config: Config, folder: Path, role: Role, common: Path | None = None) -> Numerics:
    """The settled numerics of one role in this run folder; chooses and stores them at first use.

    common: a folder where runs that are to compute alike share what the first of them chose.

    Raises StateError when the stored ones are damaged, ConfigError when they name what is missing.
    """
    if (found := known(config, folder, role)) is not None:
        return _installed(found)
    wanted: Numerics = getattr(config.numerics, role)
    chosen = settle(config, common, role) if common else choose(config, wanted, role)
    create(_path(folder, role), (json.dumps(chosen.model_dump(), indent=1) + "\n").encode())
    return settle(config, folder, role)  # another process may have been faster


def known(config: Config, folder: Path, role: Role) -> Numerics | None:
    """The settled numerics of one role in this run folder; None before they are chosen.

    Raises StateError when the stored ones are damaged.
    """
    wanted: Numerics = getattr(config.numerics, role)
    path = _path(folder, role)
    if wanted.settled or not path.exists():
        return wanted if wanted.settled else None
    try:
        return type(wanted).model_validate(json.loads(path.read_text()))
    except (OSError, ValueError) as error:
        text = first_problem(error) if isinstance(error, ValidationError) else error
        raise StateError(f"{path}: damaged: {text}") from error


def settle_all(
    config: Config,
    folder: Path,
    roles: Sequence[Role] = ROLES,
    *,
    tell: Callable[[str], None] = log.info,
    stopped: Callable[[], bool] = lambda: False,
) -> None:
    """Settle roles now, while nothing else runs that could disturb the measurement.

    In a process of its own: who calls this needs no torch afterwards. An accelerator that raises,
    hangs or dies there is named and left out. Raises ConfigError when nothing works.

    tell: gets a line at once and every `NEWS_S`. stopped: ends it; the next call goes on.
    """
    left_out: tuple[str, ...] = ()
    while left := [
        role
        for role in roles
        if not getattr(config.numerics, role).settled and not _path(folder, role).exists()
    ]:
        tried, how = _settled_elsewhere(folder, left, left_out, tell, stopped)
        if not how or stopped():
            return
        if not tried or tried in left_out:
            raise ConfigError(f"numerics of {', '.join(left)} cannot be settled here: {how}")
        log.warning("numerics: %s does not work here and is left out: %s", tried, how)
        left_out = (*left_out, tried)


def _settled_elsewhere(
    folder: Path,
    roles: Sequence[Role],
    left_out: Sequence[str],
    tell: Callable[[str], None],
    stopped: Callable[[], bool],
) -> tuple[str, str]:
    """What a child that settles roles tried last, and what it died of; empty if it did not."""
    command = (*COMMAND, str(folder), json.dumps(left_out), *roles)
    said, tried, ended = "", "", False
    with subprocess.Popen(  # in a session of its own: Ctrl-C is the parent's business
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True
    ) as child:
        assert child.stdout is not None
        start_s = heard_s = next_s = now_s = time.monotonic()
        try:
            while not (ended or stopped()) and now_s - heard_s < TRY_S:
                if now_s >= next_s:
                    next_s = now_s + NEWS_S
                    role = next((r for r in roles if not _path(folder, r).exists()), roles[-1])
                    what = f"{tried or 'loading libraries'}, {now_s - start_s:.0f} s"
                    tell(f"measuring once what computes fastest here: {role}, {what}")
                if select.select([child.stdout], [], [], POLL_S)[0]:
                    data = os.read(child.stdout.fileno(), 65536)
                    said, ended = said + data.decode(errors="replace"), not data
                    heard_s = time.monotonic()
                    tried = (re.findall(f"^{TRYING}(.*)", said, re.M) or [""])[-1]
                now_s = time.monotonic()
        finally:
            if not ended:
                child.kill()
    others = re.findall(f"^(?!{TRYING}).+", said, re.M) or ["no reason told"]
    how = others[-1] if ended else f"it took longer than {TRY_S:.0f} s"
    if ended and child.returncode < 0:
        how = signal.Signals(-child.returncode).name
    return tried, how if child.returncode else ""


def _path(folder: Path, role: Role) -> Path:
    return folder / "numerics" / f"{role}.json"


def choose(config: Config, wanted: Numerics, role: Role) -> Numerics:
    """Fill in what is left open. Raises ConfigError for what this machine does not have.

    Threads: while the learner trains synchronously nobody else works, so it takes all cores (at
    most 8), and so does replay for its passes; everything else stays with one, because two busy
    processes that share cores slow each other down far more than a second thread helps, and a GPU
    is fed by one.
    """
    threads, device = wanted.threads, wanted.device
    if device == "auto":
        device = "cuda" if _may_try("cuda") and _has_gpu() else "cpu"
    if not threads:
        alone = config.learning.mode == "synchronous" and role != "actor"
        threads = min(len(os.sched_getaffinity(0)), 8) if alone and device == "cpu" else 1
    placed = _installed(wanted.model_copy(update={"threads": threads, "device": device}))
    candidates = [each for each in _candidates(placed) if _may_try(_name(each))]
    if not candidates:
        raise ConfigError(f"numerics.{role}: {_name(placed)} does not work here")
    if len(candidates) == 1 and device == "cpu":
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


def _may_try(name: str) -> bool:
    """Whether no part of this has failed; a child says first what it tries: it may be its last."""
    if _left_out is None:
        return True
    os.write(1, f"{TRYING}{name}\n".encode())
    return not any(set(failed.split()) <= set(name.split()) for failed in _left_out)


def _name(numerics: Numerics) -> str:
    """What makes it other than the plain way."""
    words = (numerics.device, numerics.engine, numerics.precision)
    return " ".join(w for w in words if w not in ("cpu", "torch", "float32", "auto")) or "plain"


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
    work = []
    for each in candidates:
        _may_try(_name(each))
        work.append((_training if role == "learner" else _predicting)(config, each))
    times: list[list[float]] = [[] for _ in work]
    for number in range(WARM_UP + ROUNDS):
        for each, do, spent in zip(candidates, work, times, strict=True):
            _may_try(_name(each))
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


def main(folder: str, left_out: str, *roles: str) -> None:
    """Settle some roles of the run in `folder`, and say on standard output what is tried."""
    global _left_out
    config, _left_out = read_folder(Path(folder)), json.loads(left_out)
    for role in ROLES:
        if role in roles:
            settle(config, Path(folder), role)


if __name__ == "__main__":
    main(*sys.argv[1:])
