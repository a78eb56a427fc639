"""P6: what the camera's quality means for learning: bumps of policies learnt at two sizes.

The simulator renders at the size of the network's image, cheap and aliased, or at twice that size,
reduced by area. For each of three seeds and either size a narrow network learns in the
single-process loop for the same number of actions. Then it drives greedily, without learning, from
the same starts, at the size it has learnt at. Runs take minutes each. They are stored one by one,
and a later call goes on.

    python -m benchmarks.camera_quality [--jobs 2 | --check]
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

from benchmarks.frame import Bar, report, table
from experiments.drives import places
from experiments.drives.choosers import Chooser, greedy, uniform
from experiments.drives.frozen_drives import evaluate
from experiments.drives.traces import Figures
from experiments.environment import CorridorEnv
from experiments.single_process import SingleProcess
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import load_world
from shared.config import Config
from shared.facts import IMAGE_HEIGHT, IMAGE_WIDTH
from shared.provenance import commit

LONG = True
"""Too long for short measuring: the stored results stay as they are then."""
CACHE = Path(__file__).parent / ".cache"
HEIGHTS = {IMAGE_WIDTH: IMAGE_HEIGHT, 2 * IMAGE_WIDTH: 2 * IMAGE_HEIGHT}
"""Height rendered by width; the first is the configured default."""
FITNESS_OF_LAST = 100
"""Episodes, as everywhere fitness is shown."""
SECTIONS = ("robot", "episode", "reward", "policy", "network", "memory", "learning")
"""Sections of the configuration that decide the outcome of a run."""
Run = dict[str, Any]
"""What one learning run gave: settings, commit, seconds, learning, driving."""
DRIVING = {
    "bumps_per_1000": "bumps per 1000",
    "mean_run": "mean run",
    "longest_run": "longest run",
    "distance": "distance",
    "laps_left": "laps left",
    "laps_right": "laps right",
}
"""Figures of the frozen policy, and their heads."""
LEARNING = {
    "bumps": "bumps, learning",
    "fitness": "fitness, learning",
    "laps_left": "laps left, learning",
    "laps_right": "laps right, learning",
    "episodes": "episodes",
}
"""Figures of learning, after the memory was full."""


@dataclass(frozen=True)
class Plan:
    """How much of everything: equal for all runs."""

    seeds: tuple[int, ...] = (1, 2, 3)
    filters: int = 16
    capacity: int = 3000
    max_samples: int = 200
    """Samples of an episode: fewer, so that robots that do not bump learn as often."""
    fit_every: int = 10
    mini_batches: int = 4
    actions: int = 25_000
    """Learnt from after the memory is full; the episode that reaches it ends first."""
    starts: int = 24
    drive_actions: int = 400
    """Actions driven from each start without learning."""


CHECK = Plan(
    (1,), 4, 90, max_samples=60, fit_every=5, mini_batches=1, actions=150, starts=2,
    drive_actions=80,
)  # fmt: skip


def config_of(plan: Plan, seed: int, width: int) -> Config:
    """The configuration of a run: the demo's way of learning, but narrower and exploring more.

    Roulette tries only what is almost as good as the best. Where an untrained network prefers a
    turn, that is the turn alone: at the smaller size two of three seeds did nothing but circle
    after 30,000 actions. Uniform exploration, in all runs, ends that early.
    """
    camera = {"render_width_px": width, "render_height_px": HEIGHTS[width]}
    learning = {"fit_every": plan.fit_every, "mini_batches_per_episode": plan.mini_batches}
    return Config.model_validate(
        {
            "run": {"seed": seed},
            "robot": {"camera": camera},
            "network": {"filters": plan.filters},
            "policy": {"kind": "eps-greedy"},
            "memory": {"capacity": plan.capacity},
            "episode": {"max_samples": plan.max_samples},
            "learning": learning,
            "numerics": {"learner": {"precision": "bfloat16"}},
        }
    )


def settings_of(plan: Plan, seed: int, width: int) -> dict[str, Any]:
    """Everything that decides what a run gives, arithmetic aside."""
    names = ("actions", "starts", "drive_actions")
    configured = config_of(plan, seed, width).to_dict()
    return {
        "seed": seed,
        "width": width,
        "evaluation": [places.SEED, places.ROOM_M, places.JITTER_RAD],
        **{name: getattr(plan, name) for name in names},
        **{section: configured[section] for section in SECTIONS},
    }


def path_of(settings: dict[str, Any], folder: Path) -> Path:
    """Where a run with these settings is stored."""
    text = json.dumps(settings, sort_keys=True)
    key = hashlib.sha256(text.encode()).hexdigest()[:12]
    return folder / f"quality-{settings['width']}-{settings['seed']}-{key}.json"


def learnt(plan: Plan, seed: int, width: int, folder: Path) -> Run:
    """One run: learn, then drive with the last weights. Stored when it is over."""
    start_s = time.perf_counter()
    config = config_of(plan, seed, width)
    robot = SimRobot(config.robot, load_world(config.robot.world), seed)
    try:
        loop = SingleProcess(config, robot)
        learning = learn(loop, plan.actions)
        driven = drive(plan, loop.env, greedy(loop.acting))
    finally:
        robot.close()
    run: Run = {
        "settings": settings_of(plan, seed, width),
        "commit": commit(),
        "seconds": round(time.perf_counter() - start_s, 1),
        "learning": learning,
        "driving": driven,
    }
    store(run, folder)
    return run


def learn(loop: SingleProcess, actions: int) -> Figures:
    """Let the loop learn from so many actions; what it was like while learning."""
    fitness: list[int] = []
    for done in loop.run():
        if done.commit.episode:
            fitness.append(done.submitted.fitness)
        if loop.counters.actions >= actions:
            break
    counters = loop.counters
    return {
        "bumps": counters.bumps,
        "fitness": mean(fitness[-FITNESS_OF_LAST:]),
        "laps_left": counters.laps_left,
        "laps_right": counters.laps_right,
        "episodes": counters.episode,
        "actions": counters.actions,
    }


def drive(plan: Plan, env: CorridorEnv, chooser: Chooser) -> Figures:
    """Figures of all drives without learning."""
    done = evaluate(env, chooser, plan.starts, plan.drive_actions)
    laps_left = sum(trace.laps_left for trace in done.traces)
    laps_right = sum(trace.laps_right for trace in done.traces)
    return done.figures | {"laps_left": laps_left, "laps_right": laps_right}


def floor(plan: Plan) -> Figures:
    """Figures of random actions on the same drives."""
    env = CorridorEnv(config=config_of(plan, plan.seeds[0], min(HEIGHTS)))
    try:
        return drive(plan, env, uniform)
    finally:
        env.close()


def store(run: Run, folder: Path) -> None:
    """Keep a finished run; a half written file never bears its name."""
    folder.mkdir(exist_ok=True)
    path = path_of(run["settings"], folder)
    part = path.with_suffix(f".{os.getpid()}.part")
    part.write_text(json.dumps(run, indent=1) + "\n")
    part.replace(path)


def stored(settings: dict[str, Any], folder: Path) -> Run | None:
    """The stored run of these settings, if there is one."""
    path = path_of(settings, folder)
    return dict(json.loads(path.read_text())) if path.exists() else None


def all_runs(plan: Plan, folder: Path, jobs: int) -> list[Run]:
    """All runs, by size and seed; those not stored yet are made."""
    wanted = [(plan, seed, width, folder) for seed in plan.seeds for width in HEIGHTS]
    missing = [each for each in wanted if stored(settings_of(*each[:3]), folder) is None]
    for run in made(missing, jobs):
        print(f"{name_of(run)}: {run['seconds']:.0f} s, {run['driving']}", flush=True)
    keys = [settings_of(plan, seed, width) for width in HEIGHTS for seed in plan.seeds]
    return [found for key in keys if (found := stored(key, folder)) is not None]


def made(missing: Sequence[tuple[Plan, int, int, Path]], jobs: int) -> Iterator[Run]:
    """Make runs, each in a process of its own unless only one is to run at a time."""
    if jobs == 1:
        yield from (learnt(*each) for each in missing)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, max_tasks_per_child=1) as pool:
        futures = [pool.submit(learnt, *each) for each in missing]
        yield from (future.result() for future in as_completed(futures))


def name_of(run: Run) -> str:
    """The size a run rendered at, as it is written."""
    width = run["settings"]["width"]
    return f"{width}x{HEIGHTS[width]}"


def runs_table(runs: Sequence[Run], random: Figures) -> str:
    """One row for each run, and one for the random policy."""
    head = ["camera", "seed", *DRIVING.values(), *LEARNING.values(), "commit"]
    rows: list[list[object]] = [
        [
            name_of(run),
            run["settings"]["seed"],
            *(run["driving"][name] for name in DRIVING),
            *(run["learning"][name] for name in LEARNING),
            run["commit"],
        ]
        for run in runs
    ]
    blank = [None] * (len(LEARNING) + 1)
    rows.append(["random", None, *(random[name] for name in DRIVING), *blank])
    return table(head, rows)


def summary_table(runs: Sequence[Run]) -> str:
    """Return a table of each figure's mean and span at both sizes, with the difference."""
    sizes = list(dict.fromkeys(map(name_of, runs)))
    rows: list[list[object]] = []
    heads = {("driving", name): text for name, text in DRIVING.items()}
    heads |= {("learning", name): text for name, text in LEARNING.items()}
    for (part, name), text in heads.items():
        means, cells = [], []
        for size in sizes:
            values = [run[part][name] for run in runs if name_of(run) == size]
            means.append(mean(values))
            cells.append(f"{means[-1]:.3g} ({min(values):.3g}..{max(values):.3g})")
        rows.append([text, *cells, means[0] - means[1]])
    return table(["mean (span)", *sizes, "difference"], rows)


def bar(runs: Sequence[Run], random: Figures) -> Bar:
    """P6c: bumps at the default size by those at the larger one."""
    checks: dict[str, float] = {}
    for width in HEIGHTS:
        driven = [run["driving"] for run in runs if run["settings"]["width"] == width]
        found = checks_of(driven, random)
        checks |= {f"{name}_{width}": value for name, value in found.items()}
    checks["bumps_per_1000_random"] = random["bumps_per_1000"]
    # Without a single bump a ratio means nothing: at least one in all drives of a size.
    least = 1000.0 / sum(each["actions"] for each in driven)
    ours, baseline = (max(checks[f"bumps_per_1000_{width}"], least) for width in HEIGHTS)
    unit = "x bumps of 150x100"
    n = len(runs) // len(HEIGHTS)
    return Bar("P6c", ours / baseline, unit, "lower", 1.25, 1.0, baseline, ours, n, checks)


def checks_of(driven: Sequence[Figures], random: Figures) -> Figures:
    """What belongs to the bumps of one size.

    Runs that get less far than random actions have learnt to circle, not to drive: few bumps are
    no success then, so they are counted as nowhere.
    """
    rates = [each["bumps_per_1000"] for each in driven]
    return {
        "bumps_per_1000": mean(rates),
        "least": min(rates),
        "most": max(rates),
        "distance": mean(each["distance"] for each in driven),
        "laps": mean(each["laps_left"] + each["laps_right"] for each in driven),
        "nowhere": sum(each["distance"] < random["distance"] for each in driven),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Make what is missing and report."""
    parser = argparse.ArgumentParser(description=__doc__)
    cores = len(os.sched_getaffinity(0))
    parser.add_argument("--jobs", type=int, default=min(2, cores), help="runs at a time")
    parser.add_argument("--check", action="store_true", help="tiny: does it run at all")
    given = parser.parse_args(arguments)
    plan = CHECK if given.check else Plan()
    with tempfile.TemporaryDirectory() as nowhere:
        folder, jobs = (Path(nowhere), 1) if given.check else (CACHE, given.jobs)
        runs = all_runs(plan, folder, jobs)
    random = floor(plan)
    report("Camera quality", [runs_table(runs, random), summary_table(runs)], [bar(runs, random)])


if __name__ == "__main__":
    main()
