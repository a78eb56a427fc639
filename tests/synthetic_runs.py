"""Made-up runs of experiments on disk, shaped like real ones: for tests of what reads them."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.drives import routes
from experiments.drives.routes import Event
from experiments.drives.traces import Trace
from experiments.records import EVALUATION_COLUMNS
from experiments.report.document import Findings, Missing, Picture, Section
from experiments.report.run_folder import Experiment, load
from shared.run_record import EPISODE_COLUMNS, Row, write_csv

FACTOR = 10.0
AFTER = {"plus-normm-fit": "plus-normm", "plus-minus": "plus-rmm", "i16c": "plus-minus"}


@dataclass(frozen=True)
class Shape:
    """How a made-up experiment goes."""

    stages: tuple[tuple[str, str, int], ...]
    """Name, world and episodes of each."""
    first_episode: int = 1
    best: float = 200.0
    """Mean fitness at the end."""
    balanced: bool = True
    fits: bool = True
    bumps: float = 8.0
    thesis: tuple[tuple[str, float | str], ...] = ()


SHAPES = {
    "plus-normm": Shape((("learn", "plus", 1500),), best=120, balanced=False, fits=False, bumps=20,
                        thesis=(("episodes", 15000), ("actions", 1_584_893),
                                ("actions_per_episode", 105.7), ("longest_run", 8719))),
    "plus-normm-fit": Shape((("learn with fits", "plus", 500),), 1501, best=170, balanced=False,
                            bumps=14),
    "plus-rmm": Shape((("NoRMM, small memory", "plus", 100), ("NoRMM", "plus", 100),
                       ("filter", "plus", 100), ("RMM", "plus", 400)), best=260, bumps=6,
                      thesis=(("episodes", 7000), ("longest_run", 18211),
                              ("max_threshold_percent", 3), ("robot", "simulated Robotino"))),
    "plus-rmm-nopretrain": Shape((("RMM", "plus", 500),), best=230, bumps=7),
    "plus-minus": Shape((("Minus", "minus", 150), ("Plus", "plus", 150)), 701, best=280, bumps=5),
    "i16c": Shape((("I16c", "i16c", 300),), 1001, best=100, bumps=12),
    "policy-eps-greedy": Shape((("learn", "plus", 100),), best=40,
                               thesis=(("fitness", 38),)),
    "policy-roulette": Shape((("learn", "plus", 100),), best=15,
                             thesis=(("fitness", 16),)),
    "policy-eps-greedy-roulette": Shape((("learn", "plus", 100),), best=35,
                                        thesis=(("fitness", 36),)),
}  # fmt: skip
VARIANT = Shape((("learn", "plus", 100),), best=60, bumps=9)
"""Of every other name."""


def write_run(out: Path, experiment: str, seed: int, **changes: Any) -> Path:
    """Write one seed of a made-up experiment; returns its folder.

    Args:
        out: Folder of all experiments.
        experiment: One of SHAPES, or a variant that none of the thesis's figures shows.
        seed: Everything is drawn from it and from the name.
        changes: Of run.json.
    """
    shape = SHAPES.get(experiment, VARIANT)
    draw = np.random.default_rng([seed, *experiment.encode()])
    folder = out / f"{experiment}-tenth" / f"seed-{seed}"
    folder.mkdir(parents=True)
    episodes = _episodes(shape, draw)
    write_csv(folder / "episodes.csv", EPISODE_COLUMNS, episodes)
    write_csv(folder / "evaluations.csv", EVALUATION_COLUMNS, _evaluations(shape, episodes, draw))
    worlds = {world for _, world, _ in shape.stages} | ({"plus"} if "plus" in experiment else set())
    for label in ("best", shape.stages[-1][0]):
        for world in sorted(worlds):
            write_probes(folder / f"probes-{label}-{world}.npz", world, draw)
    info = _info(experiment, shape, seed, episodes) | changes
    (folder / "run.json").write_text(json.dumps(info, indent=1))
    return folder


def _episodes(shape: Shape, draw: np.random.Generator) -> list[Row]:
    total = sum(count for _, _, count in shape.stages)
    rows: list[Row] = []
    actions = bumps = longest = steps = fits = run = 0
    for index in range(total):
        stage, world = _stage_at(shape, index)
        number = shape.first_episode + index
        mean = shape.best * (0.1 + 0.9 * (1 - math.exp(-4 * index / total)))
        fitness = min(500, 1 + int(draw.exponential(mean)))
        fit = shape.fits and number % 10 == 0 and "NoRMM" not in stage and stage != "filter"
        bump = fitness < 500
        batches = 0 if stage == "filter" else 300 if fit else 1
        actions += fitness
        run = 0 if bump else run + fitness
        bumps, longest = bumps + bump, max(longest, run, fitness)
        steps, fits = steps + batches, fits + fit
        shares = np.array([0.55, 0.15, 0.3]) if not shape.balanced else np.full(3, 1 / 3)
        held = (4500 * shares * (1 + draw.normal(0, 0.01, 3))).astype(int)
        minus = int(min(3000, 25 * index)) if world != "i16c" and len(shape.stages) == 2 else 0
        rows.append({
            "episode": number, "stage": stage, "world": world,
            "ended": "bump" if bump else "full", "bump": int(bump), "fitness": fitness,
            "actions": fitness, "total_actions": actions, "bumps": bumps,
            "laps_left": actions // 150, "laps_right": actions // 400,
            "longest_run_actions": longest, "mini_batches": batches,
            "loss": 0.2 * math.exp(-5 * index / total) + 0.005 + abs(draw.normal(0, 0.01))
            if batches else "",
            "fitting": int(fit), "train_steps": steps, "fits": fits, "weights_version": number,
            "target_age": 0, "memory": int(held.sum()), "capacity": 4500,
            "forward": held[0], "left": held[1], "right": held[2],
            "by_world": f"minus={minus} plus={held.sum() - minus}" if minus
            else f"{world if len(shape.stages) != 2 else 'plus'}={held.sum()}",
            "discarded": fitness, "last_resort": 0, "recomputed": 0, "equalised": 0,
            "threshold_percent": 1 + 3 * index // total, "seconds": 0.5 * index,
        })  # fmt: skip
    return rows


def _stage_at(shape: Shape, index: int) -> tuple[str, str]:
    for name, world, count in shape.stages:
        if index < count:
            return name, world
        index -= count
    raise IndexError(index)


def _evaluations(shape: Shape, episodes: list[Row], draw: np.random.Generator) -> list[Row]:
    worlds = sorted({world for _, world, _ in shape.stages} | {"plus"})
    rows = []
    for world in worlds:
        for driver, rate in (("random", 75.0), ("planner", 0.5)):
            rows.append(_evaluation("reference", driver, "", episodes[0], world, rate))
    step = max(1, len(episodes) // 12)
    for i in range(0, len(episodes), step):
        for world in worlds:
            wanted = 60 * math.exp(-5 * i / len(episodes)) + shape.bumps
            rate = max(0.1, wanted * (1 + draw.normal(0, 0.1)))
            stage = str(episodes[i]["stage"])
            rows.append(_evaluation("every", "network", stage, episodes[i], world, rate))
    for world in worlds:
        rate = shape.bumps * (1 + 0.1 * draw.normal())
        rows.append(_evaluation("end", "network", "", episodes[-1], world, rate))
    return rows


def _evaluation(
    label: str, driver: str, stage: str, at: Row, world: str, bumps_per_1000: float
) -> Row:
    laps = 0.0 if world == "minus" else 4 / (1 + bumps_per_1000 / 10)
    return {
        "label": label, "driver": driver, "stage": stage, "episode": at["episode"],
        "total_actions": at["total_actions"], "train_steps": at["train_steps"], "world": world,
        "actions": 6400, "bumps": round(6.4 * bumps_per_1000), "bumps_per_1000": bumps_per_1000,
        "bumps_per_100m": 2 * bumps_per_1000, "mean_run": 1000 / bumps_per_1000,
        "longest_run": 400, "fitness": min(500.0, 1000 / bumps_per_1000),
        "laps_left_per_1000": laps, "laps_right_per_1000": laps / 8,
        "distance": 0.8 / (1 + bumps_per_1000 / 40), "coverage": 0.6, "circling": 0.02,
        "seconds": at["seconds"],
    }  # fmt: skip


def write_probes(path: Path, world: str, draw: np.random.Generator, count: int = 16) -> None:
    """Pictures that get darker towards the far end of a corridor, the same for every network."""
    row, column = np.mgrid[0:50, 0:75]
    images = np.stack(
        [
            np.clip(90 + 2 * np.hypot(row - 25, column - 20 - 2 * i) + 10 * (row > 35), 0, 255)
            for i in range(count)
        ]
    ).astype(np.uint8)
    values = np.clip(draw.normal(0.3, 0.5, (count, 3)), -1, 1).astype(np.float32)
    np.savez_compressed(
        path, images=images, values=values, world=np.array(world),
        x_m=np.zeros(count), y_m=np.zeros(count), heading_rad=np.zeros(count),
    )  # fmt: skip


def write_route(path: Path, world: str, places_m: list[tuple[float, float]]) -> None:
    """A way through places, with a bump at the second action and two events."""
    count = len(places_m) - 1
    trace = Trace(
        world, np.arange(count) == 1, np.array(places_m), np.zeros(count + 1), np.full(count, 0.1),
        0, 0,
    )  # fmt: skip
    events = (Event(1, 1, "passes the window"), Event(2, count, "turns"))
    routes.write(path, routes.Route(trace, events))


def _info(experiment: str, shape: Shape, seed: int, episodes: list[Row]) -> dict[str, Any]:
    stages, first = [], shape.first_episode
    for name, world, count in shape.stages:
        stages.append({
            "name": name, "world": world, "first_episode": first,
            "last_episode": first + count - 1,
        })  # fmt: skip
        first += count
    return {
        "experiment": experiment, "title": experiment.replace("-", " ").capitalize(),
        "scale": "tenth", "factor": FACTOR, "seed": seed,
        "command": f"experiment {experiment} --seed {seed}", "commit": "0123abc",
        "machine": "2 cores, AMD EPYC", "python": "3.11.9", "torch": "2.13.0",
        "started": "2026-01-01T00:00:00Z", "finished": "2026-01-01T01:00:00Z",
        "after": AFTER.get(experiment, ""), "prefill": f"fill-{seed}",
        "first_lap": {"seconds": 60.0 * seed, "actions": 9000, "episode": 90},
        "seconds": 3600.0, "actions": episodes[-1]["total_actions"], "episodes": len(episodes),
        "train_steps": episodes[-1]["train_steps"], "complete": True, "stages": stages,
        "thesis": dict(shape.thesis),
    }  # fmt: skip


def experiment(out: Path, name: str, seeds: Sequence[int] = (1,)) -> Experiment:
    """Made-up runs of one experiment, written and read again."""
    (found,) = load([write_run(out, name, seed) for seed in seeds])
    return found


def titles(section: Section) -> list[str]:
    """Titles of the pictures of a section."""
    return [block.title for block in section.blocks if isinstance(block, Picture)]


def missing(section: Section) -> list[str]:
    """What a section leaves out."""
    return [block.what for block in section.blocks if isinstance(block, Missing)]


def sentences(section: Section) -> str:
    """The findings of a section, one a line."""
    told = [block.sentences for block in section.blocks if isinstance(block, Findings)]
    return "\n".join(sentence for group in told for sentence in group)
