"""Many runs of a plan: seeds side by side, predecessors first, progress in the terminal.

`corridor experiment NAME --scale tenth --seeds 3` runs a plan with its first three seeds, two at a
time on two cores. Run again, it goes on where it was stopped; finished runs are left alone.
"""

import multiprocessing
import os
import queue
import signal
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing.context import SpawnContext
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bars

from experiments.plans.plan import Plan, full_plan, plan_names
from experiments.plans.scale_model import description
from experiments.plans.scales import load_plan
from experiments.runs.run import Run
from experiments.runs.totals import Progress
from shared.errors import ConfigError, CorridorError

OUT = Path("runs") / "experiments"
"""Default folder of all experiments."""
POLL_S = 0.5
STOPS = (signal.SIGINT, signal.SIGTERM)


@dataclass(frozen=True)
class Job:
    """One run to be done."""

    plan: str
    scale: str
    seed: int
    out: Path

    @property
    def folder(self) -> Path:
        """Folder of the run."""
        return self.out / f"{self.plan}-{self.scale}" / f"seed-{self.seed}"

    @property
    def name(self) -> str:
        """Name of its progress bar."""
        return f"{self.plan} {self.seed}"


def chain(name: str, scale: str) -> list[Plan]:
    """A plan and those it goes on from, the first one first (A46). Raises ConfigError."""
    plan = load_plan(name, scale)
    return [*chain(plan.after, scale), plan] if plan.after else [plan]


def run_experiment(
    names: Sequence[str],
    scale: str,
    seeds: Sequence[int] | int,
    out: Path,
    jobs: int,
    console: Console,
) -> bool:
    """Run plans with some seeds, predecessors included; whether all came to their end.

    Args:
        names: Names of plans.
        scale: Name of a scale.
        seeds: The seeds, or how many of each plan's own seeds, from the first on.
        out: Folder for all runs.
        jobs: Runs side by side; they divide the cores among them.
        console: Where progress is shown.

    Raises:
        ConfigError: No plan of that name, or one that cannot be run.
        CorridorError: A run failed; the others were stopped after their current turn.
    """
    pieces = _pieces(names, scale, seeds, out)
    context: Any = multiprocessing.get_context("spawn")
    reports, stop = context.Queue(), context.Event()
    shares = _queue_of(context, shares_of(sorted(os.sched_getaffinity(0)), jobs))
    for number in STOPS:  # also where the shell had SIGINT ignored, as it does in the background
        signal.signal(number, signal.default_int_handler)
    with (
        ProcessPoolExecutor(jobs, context, _begin, (reports, stop, shares)) as pool,
        _bars(console) as bars,
    ):
        signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)  # workers inherit it, and start in peace
        futures = [pool.submit(_work, piece) for piece in pieces]
        try:
            _watch(futures, reports, bars)
        except KeyboardInterrupt:
            console.print("stopping after the current turns; the same command goes on")
            stop.set()
        return _results(futures, stop)


def shares_of(cores: Sequence[int], jobs: int) -> list[set[int]]:
    """Cores of each of the runs side by side: different ones as far as there are enough."""
    return [set(cores[job % len(cores) :: jobs]) for job in range(jobs)]


def _queue_of(context: SpawnContext, items: Iterable[object]) -> Any:
    """A queue to other processes that holds these items."""
    made: Any = context.Queue()
    for item in items:
        made.put(item)
    return made


def _pieces(
    names: Sequence[str], scale: str, seeds: Sequence[int] | int, out: Path
) -> list[list[Job]]:
    """The jobs of an experiment as pieces of work. Raises ConfigError."""
    chains = [chain(name, scale) for name in names]
    wanted = [
        [Job(plan.name, scale, seed, out) for plan in plans]
        for plans in chains
        for seed in (plans[-1].seeds[:seeds] if isinstance(seeds, int) else seeds)
    ]
    return _distinct(wanted)


def _distinct(chains: list[list[Job]]) -> list[list[Job]]:
    """Chains that share jobs joined into one piece of work, each job once, in order."""
    pieces: list[list[Job]] = []
    for jobs in chains:
        common = next((piece for piece in pieces if set(piece) & set(jobs)), None)
        if common is None:
            pieces.append(list(jobs))
        else:
            common.extend(job for job in jobs if job not in common)
    return pieces


def _results(futures: list[Future[bool]], stop: Any) -> bool:
    """Whether all are complete; the first failure stops the others and is raised."""
    try:
        complete = [future.result() for future in futures]
    except BaseException:
        stop.set()
        raise
    return all(complete)


def _bars(console: Console) -> Bars:
    return Bars(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[text]}"),
        TimeRemainingColumn(),
        console=console,
    )


def _watch(futures: list[Future[bool]], reports: Any, bars: Bars) -> None:
    """Show what the runs report until all are done or one failed."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPS)
    tasks: dict[str, Any] = {}
    while True:
        try:
            progress: Progress = reports.get(timeout=POLL_S)
        except queue.Empty:
            if all(future.done() for future in futures) or _failed(futures):
                return
            continue
        if progress.run not in tasks:
            tasks[progress.run] = bars.add_task(progress.run, total=progress.of, text="")
        text = f"{progress.unit}, fitness {progress.fitness:.0f}"
        bars.update(tasks[progress.run], completed=progress.done, text=text)


def _failed(futures: list[Future[bool]]) -> bool:
    return any(future.done() and future.exception() is not None for future in futures)


# ---------------------------------------------------------------- `corridor experiment`


def listing() -> str:
    """All plans with what they are, one a line."""
    plans = [full_plan(name) for name in plan_names()]
    width = max(len(plan.name) for plan in plans)
    return "\n".join(
        f"{plan.name:{width}}  {plan.title} ({plan.source})"
        + (f"; after {plan.after}" if plan.after else "")
        for plan in plans
    )


def described(names: Sequence[str], scale: str) -> str:
    """How much of the plans a scale keeps. Raises ConfigError."""
    return "\n\n".join(description(name, scale) for name in names)


def run(
    names: Sequence[str], scale: str, seeds: int, seed: int | None, jobs: int, out: Path | None
) -> int:
    """Run them; returns 0, or 1 when stopped before the end. Raises ConfigError, CorridorError."""
    wanted = seeds if seed is None else [seed]
    for name in names:
        available = load_plan(name, scale).seeds
        if isinstance(wanted, int) and wanted > len(available):
            raise ConfigError(f"--seeds: {name} has {len(available)} seeds, got {wanted}")
    return 0 if run_experiment(names, scale, wanted, out or OUT, jobs, Console()) else 1


# ---------------------------------------------------------------- in the worker processes

_reports: Any = None
_stop: Any = None


def _begin(reports: Any, stop: Any, shares: Any) -> None:
    """Prepare a worker: stopping is the main process's business, and the cores are divided.

    A plan may leave the number of threads to the cores there are: on the same ones, runs would slow
    each other down.
    """
    global _reports, _stop
    for number in STOPS:
        signal.signal(number, signal.SIG_IGN)
    os.sched_setaffinity(0, shares.get())
    _reports, _stop = reports, stop
    _end_with_parent()


def _end_with_parent() -> None:
    """A worker whose main process was killed must not go on for hours."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _work(jobs: Sequence[Job]) -> bool:
    """Run jobs one after the other; whether all came to their end."""
    return all(do(job, _reports.put, _stop.is_set) for job in jobs)


def do(job: Job, report: Callable[[Progress], None], stopped: Callable[[], bool]) -> bool:
    """One job; whether it is complete. Raises CorridorError."""
    if stopped():
        return False
    plan = load_plan(job.plan, job.scale)
    before = Job(plan.after, job.scale, job.seed, job.out).folder if plan.after else None
    command = f"corridor experiment {job.plan} --scale {job.scale} --seed {job.seed}"
    try:
        run = Run(plan, job.scale, job.seed, job.folder, before, command)
    except CorridorError as error:
        raise type(error)(f"{job.name}: {error}") from error
    try:
        return run.go(report, stopped)
    finally:
        run.close()
