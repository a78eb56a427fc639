"""The benchmark's work: record streams, let entries manage them, let networks learn and drive.

    <out>/streams/<setting>/<plan>-<scale>/seed-<n>/   the run that recorded it
    <out>/streams/<setting>/stream-<n>/                the stream, some gigabytes at N = 4,500
    <out>/measured/<setting>/<entry>-<seed>.json       a `Measured`

Run again, it goes on: what is measured is left alone, and a recording continues.
"""

import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import get_args

from pydantic import BaseModel, ConfigDict
from rich.console import Console

from experiments.drives.choosers import greedy, side_by_side
from experiments.drives.frozen_drives import evaluate
from experiments.drives.traces import Figures
from experiments.environment import CorridorEnv, with_world
from experiments.plans.plan import Plan, stage_config
from experiments.plans.scales import load_plan
from experiments.retention.benchmark import (
    Benchmark,
    Entry,
    Setting,
    Work,
    config_of,
    load_benchmark,
)
from experiments.retention.contents import Mark, figures, managed
from experiments.retention.offline import selected
from experiments.retention.refresh import Refresher
from experiments.retention.stream import Recorder, Stream
from experiments.runs.run import Run
from shared.config import Config, LearnerNumerics
from shared.errors import ConfigError
from shared.numerics import Role, settle
from shared.provenance import machine_key
from shared.rl.gradients import MeanOfWeights
from shared.rl.learning import Trainer
from shared.rl.memory import SampleStore
from shared.rl.network import QNetwork, to_bytes
from shared.rl.predictor import Predictor
from shared.rl.schedule import Moment
from shared.run_record import EPISODE_COLUMNS, EPISODES, RUN, RunInfo, made_here, read_csv
from shared.statefile import write_atomically

OUT = Path("runs") / "retention"
"""Default folder of streams and results."""
Tell = Callable[[str], None]


class Network(BaseModel):
    """What one network made of one memory."""

    model_config = ConfigDict(frozen=True)
    mark: str
    """The stage at whose end the memory was taken."""
    number: int
    """Which of the networks of this memory."""
    contents: dict[str, float]
    drives: dict[str, dict[str, float]]
    """Figures of frozen drives by world."""


class Measured(BaseModel):
    """An entry with one seed of a setting."""

    model_config = ConfigDict(frozen=True)
    setting: str
    entry: str
    seed: int
    networks: tuple[Network, ...]
    seconds: float
    commit: str
    machine: str


def measure(
    benchmark: Benchmark, work: Sequence[Work], out: Path, tell: Tell, stopped: Callable[[], bool]
) -> bool:
    """Do everything of `work` that is not done yet; return whether all is. Raises CorridorError."""
    for piece in work:
        path = measured_path(out, piece)
        if path.exists():
            continue
        if stopped():
            return False
        label = f"{piece.setting.name}, seed {piece.seed}"
        stream = _recorded(piece.setting, piece.seed, out, tell, stopped)
        if stream is None:
            return False
        tell(f"{label}: {piece.entry.name}")
        write_atomically(path, _measured(benchmark, piece, stream, out).model_dump_json().encode())
    return True


def measured_path(out: Path, work: Work) -> Path:
    """Where the result of a piece of work lies."""
    return out / "measured" / work.setting.name / f"{work.entry.name}-{work.seed}.json"


def _recorded(
    setting: Setting, seed: int, out: Path, tell: Tell, stopped: Callable[[], bool]
) -> Stream | None:
    """The stream of a setting, recorded first where it is missing; None if that was stopped."""
    plan = load_plan(setting.plan, setting.scale)
    base = out / "streams" / setting.name
    folder = base / f"stream-{seed}"
    run_folder = _run_folder(setting, seed, out)
    command = f"corridor retention --setting {setting.name} --seed {seed}"
    run = Run(plan, setting.scale, seed, run_folder, None, command, Recorder(folder))
    try:
        if not run.complete:
            tell(f"{setting.name}, seed {seed}: recording the stream")
        if not run.go(lambda _: None, stopped):
            return None
    finally:
        run.close()
    return Stream(folder)


def _run_folder(setting: Setting, seed: int, out: Path) -> Path:
    run = f"{setting.plan}-{setting.scale}"
    return out / "streams" / setting.name / run / f"seed-{seed}"


def _measured(benchmark: Benchmark, work: Work, stream: Stream, out: Path) -> Measured:
    """Manage the stream, and let networks learn at every mark."""
    began_s = time.monotonic()
    setting, entry, seed = work
    plan = load_plan(setting.plan, setting.scale)
    config = _settled(config_of(plan, entry, seed), plan, seed, out)
    info = RunInfo.model_validate_json((_run_folder(setting, seed, out) / RUN).read_bytes())
    marks = setting.marks or benchmark.marks
    ends = {
        stage.last_episode: stage.name
        for stage in info.stages
        if stage.last_episode is not None and stage.name in marks
    }
    losses = _losses(_run_folder(setting, seed, out))
    networks = [
        network
        for mark in _marks(entry, stream, config, ends, losses)
        for network in _networks(benchmark, entry, mark, config)
    ]
    made = made_here()
    return Measured(
        setting=setting.name,
        entry=entry.name,
        seed=seed,
        networks=tuple(networks),
        seconds=round(time.monotonic() - began_s, 1),
        commit=str(made["commit"]),
        machine=str(made["machine"]),
    )


def _marks(
    entry: Entry,
    stream: Stream,
    config: Config,
    ends: Mapping[int, str],
    losses: Mapping[int, float],
) -> Iterator[Mark]:
    """The memories of an entry at the ends of stages."""
    numerics = config.numerics.replay
    if entry.offline is not None:
        return selected(stream, config, numerics, ends, entry.offline)
    refresher = Refresher(entry.refresh, stream, config, losses)
    every = round(entry.refresh_every * config.memory.capacity)
    return managed(stream, config, numerics, ends, refresher, every)


def _losses(run: Path) -> dict[int, float]:
    """The mean loss of the fitting phase behind each version of the network."""
    rows = read_csv(run / EPISODES, EPISODE_COLUMNS)
    fits = (row for row in rows if row["fitting"] == "1")
    return {int(row["weights_version"]): float(row["loss"]) for row in fits}


def _networks(benchmark: Benchmark, entry: Entry, mark: Mark, config: Config) -> list[Network]:
    """Networks that learn from a memory and drive."""
    held = {name: round(value, 5) for name, value in figures(mark, config).items()}
    found = []
    for number in range(1, entry.networks + 1):
        weights = learned(
            mark.memory,
            config,
            config.numerics.learner,
            seed=1000 * number + config.run.seed,
            steps=entry.steps or benchmark.steps,
            averaged=benchmark.averaged_steps,
        )
        drives = driven(weights, config, benchmark.worlds, benchmark.starts, benchmark.actions)
        told = {
            world: {name: round(float(value), 5) for name, value in of_world.items()}
            for world, of_world in drives.items()
        }
        found.append(Network(mark=mark.stage, number=number, contents=held, drives=told))
    return found


def _settled(config: Config, plan: Plan, seed: int, out: Path) -> Config:
    """The configuration with numerics that all entries share on this machine."""
    common = out / "machines" / machine_key(stage_config(plan, 0, seed))
    roles = {role: settle(config, common, role) for role in get_args(Role)}
    numerics = config.numerics.model_copy(update=roles)
    return config.model_copy(update={"numerics": numerics})


def learned(
    samples: SampleStore,
    config: Config,
    numerics: LearnerNumerics,
    seed: int,
    steps: int,
    averaged: int,
) -> bytes:
    """Let a network learn from these samples, in shuffled epochs, from random weights on.

    The weights of the last `averaged` steps are averaged: the mean, as safetensors bytes.
    """
    epochs = -(-steps * config.learning.batch_size // len(samples)) + 1
    learning = config.learning.model_copy(
        update={"fit_every": 1, "fit_every_actions": 0, "fit_epochs": epochs}
    )
    trainer = Trainer(config.network, learning, numerics, seed)
    mean = MeanOfWeights(trainer.train_network)
    for done, _ in enumerate(islice(trainer.learn(samples, Moment(1)), steps), 1):
        if done > steps - averaged:
            mean.take()
    network = QNetwork(config.network).requires_grad_(False)
    mean.copy_to(network)
    return to_bytes(network)


def driven(
    weights: bytes, config: Config, worlds: Sequence[str], starts: int, actions: int
) -> dict[str, Figures]:
    """Let a frozen network drive in worlds; return the figures of each."""
    network = Predictor(config.network, side_by_side(config.numerics.actor))
    network.load(1, weights)
    found = {}
    for world in worlds:
        env = CorridorEnv(config=with_world(config, world))
        try:
            found[world] = evaluate(env, greedy(network), starts, actions).figures
        finally:
            env.close()
    return found


def run(
    setting: str, seeds: Sequence[int], entries: Sequence[str], out: Path | None, console: Console
) -> int:
    """Measure all seeds and entries, or these; return 0, or 1 when stopped before the end.

    Raises:
        ConfigError: There is no such setting or entry.
        CorridorError: A stream cannot be recorded or read.
    """
    benchmark, folder = load_benchmark(), out or OUT
    work = chosen(benchmark, setting, seeds, entries)
    stop = [False]

    def stopping(*_: object) -> None:
        stop[0] = True
        console.print("stopping; the same command goes on")

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stopping)
    done = sum(measured_path(folder, piece).exists() for piece in work)
    console.print(f"{len(work)} measurements, {done} of them done; results in {folder}")
    return 0 if measure(benchmark, work, folder, console.print, lambda: stop[0]) else 1


def chosen(
    benchmark: Benchmark, setting: str, seeds: Sequence[int], entries: Sequence[str]
) -> list[Work]:
    """Return the work, seed by seed. Raises ConfigError."""
    known = {entry.name for entry in benchmark.entries}
    if unknown := set(entries) - known:
        expected = ", ".join(sorted(known))
        raise ConfigError(f"--entry: expected one of {expected}, got {unknown.pop()!r}")
    found = benchmark.setting(setting)
    return [
        Work(found, entry, seed)
        for seed in seeds or range(1, benchmark.primary_seeds + 1)
        for entry in benchmark.entries_of(found, seed)
        if not entries or entry.name in entries
    ]
