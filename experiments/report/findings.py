"""Sentences about what was seen: fixed rules turn numbers into words.

What the thesis says, and whether it holds, stands in the table of claims (`claims`).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from experiments.drives.traces import Trace
from experiments.report.figures.progress import curve_of
from experiments.report.measures import (
    MISSING,
    Kept,
    evaluated,
    longest_run,
    loss_ratio,
    max_mean_fitness,
    number,
    of_seeds,
    spread,
)
from experiments.report.run_folder import Experiment, Floats, RunFolder
from shared.facts import SHORT_NAMES

BALANCED = 0.05
"""Shares of the actions that differ by at most this are called balanced."""
MUCH_CIRCLING = 0.2
COLLAPSE = 0.25
"""A mean fitness below this part of the median of its curve is called a collapse."""


def completeness(experiment: Experiment) -> list[str]:
    """Which seeds there are, and which of them are not complete."""
    seeds = ", ".join(str(run.info.seed) for run in experiment.runs)
    told = [f"Seeds: {seeds}."]
    told += [
        f"Seed {run.info.seed} is not complete: {number(len(run.episodes))} episodes so far."
        for run in experiment.runs
        if not run.info.complete
    ]
    return told


def fitness(experiment: Experiment) -> list[str]:
    """The highest point of the curve, beside that of the thesis where it gives one."""
    values = of_seeds(experiment, max_mean_fitness)
    if not len(values):
        return ["Too few episodes for a point of the fitness curve."]
    window = experiment.runs[0].window
    told = f"The highest mean fitness over {window} episodes was {spread(values)}"
    theirs = experiment.first.thesis.get("fitness")
    longest = spread(of_seeds(experiment, longest_run))
    return [
        f"{told}; thesis: {theirs}." if theirs is not None else f"{told}.",
        f"The longest way without a bump had {longest} actions.",
    ]


def first_lap(experiment: Experiment) -> list[str]:
    """When frozen networks first drove a whole lap, where that was looked at."""
    laps = [run.info.first_lap for run in experiment.runs]
    driven = [lap for lap in laps if lap]
    if not driven:
        return []
    actions, seconds = (np.array([lap[name] for lap in driven]) for name in ("actions", "seconds"))
    told = f"{len(driven)} of {len(laps)} seeds drove a first lap frozen, after {spread(actions)}"
    return [f"{told} actions, {spread(seconds)} s of learning."]


def same_start(experiments: Sequence[Experiment]) -> list[str]:
    """Whether seeds that several experiments share began with equal memories (A38, A46)."""
    if len(experiments) < 2:
        return []
    fills: dict[int, set[str]] = {}
    for experiment in experiments:
        for run in experiment.runs:
            if run.info.prefill:
                fills.setdefault(run.info.seed, set()).add(run.info.prefill)
    differ = [str(seed) for seed, prefills in sorted(fills.items()) if len(prefills) > 1]
    if differ:
        return [f"In seed {', '.join(differ)} the memories were not equal at the beginning."]
    return ["The memories of each seed were equal at the beginning."] if fills else []


def loss(experiment: Experiment) -> list[str]:
    """Loss after the first fitting phase over that before it; without one, at the end."""
    found = of_seeds(experiment, loss_ratio)
    if not len(found):
        return []
    fits = any(np.any(run.episodes.numbers("fitting") > 0) for run in experiment.runs)
    when = "From before to after the first fitting phase" if fits else "From first to last"
    return [f"{when}, the mean loss went to {spread(100.0 * found)} % of what it was."]


def memory(experiment: Experiment) -> list[str]:
    """Shares of the actions at the end, and whether they are balanced in most seeds."""
    shares = {name: of_seeds(experiment, partial(_share, name)) for name in SHORT_NAMES}
    if not len(shares[SHORT_NAMES[0]]):
        return []
    spans = np.ptp(np.stack(list(shares.values())), axis=0)
    told = ", ".join(f"{name} {100 * np.median(each):.1f} %" for name, each in shares.items())
    when = "At the end" if all(run.info.complete for run in experiment.runs) else "So far"
    seeds = f"{np.count_nonzero(spans <= BALANCED)} of {len(spans)} seeds"
    return [f"{when} the memory held {told} (medians). It was balanced in {seeds}."]


def _share(action: str, run: RunFolder) -> float:
    counts = {name: run.episodes.numbers(name)[-1:] for name in SHORT_NAMES}
    total = sum(float(values.sum()) for values in counts.values())
    return float(counts[action][0]) / total if total else MISSING


def worlds_in_memory(experiment: Experiment) -> list[str]:
    """Samples per corridor at the end."""
    names = sorted({name for run in experiment.runs for name in run.samples_by_world})
    last = {
        name: np.array([run.samples_by_world.get(name, np.zeros(1))[-1] for run in experiment.runs])
        for name in names
    }
    return [f"Samples at the end: {'; '.join(f'{n} {spread(v)}' for n, v in last.items())}."]


def evaluation(experiment: Experiment, world: str) -> list[str]:
    """The newest drive of the frozen network beside floor and ceiling, and much circling."""
    bumps = of_seeds(experiment, evaluated("bumps_per_1000", world))
    if not len(bumps):
        return []
    laps, distance, coverage, circling = (
        of_seeds(experiment, evaluated(column, world))
        for column in ("laps", "distance", "coverage", "circling")
    )
    told = f"In {world} the frozen network had {spread(bumps)} bumps and {spread(laps)} laps per "
    told += f"1,000 actions. On average it was {spread(distance)} of the farthest possible from "
    told += f"where it was 50 actions ago. It visited {spread(coverage)} of the corridor."
    for driver, name in (("random", "Random actions"), ("planner", "The planner")):
        other = of_seeds(experiment, evaluated("bumps_per_1000", world, driver))
        if len(other):
            told += f" {name} had {number(float(np.median(other)))} bumps."
    sentences = [told]
    much = int(np.sum(circling > MUCH_CIRCLING))
    if much:
        sentences.append(
            f"Mind the circling in {world}: the robot circles {spread(100 * circling)} % of the "
            f"time, and {much} of {len(circling)} seeds circle more than "
            f"{100 * MUCH_CIRCLING:.0f} % of it. Few bumps or a high fitness do not mean that "
            "these seeds drive well."
        )
    return sentences


def drive(trace: Trace) -> str:
    """How long a drive was and how often it bumped."""
    bumps = int(trace.bumps.sum())
    return f"{len(trace.bumps)} actions, {bumps} bump{'' if bumps == 1 else 's'}."


def highest_fitness(experiments: Sequence[Experiment]) -> str:
    """Highest mean fitness of each."""
    best = (f"{e.name} {spread(of_seeds(e, max_mean_fitness))}" for e in experiments)
    return f"Highest mean fitness: {'; '.join(best)}."


def continued(before: Experiment, after: Experiment) -> list[str]:
    """Whether the fitness rose where a run goes on from another, and whether it collapsed (A40)."""
    old, new = _pooled(before), _pooled(after)
    if not len(old) or not len(new):
        return []
    late, middle = float(np.mean(old[-max(1, len(old) // 4) :])), float(np.mean(new))
    fell = float(new.min()) < COLLAPSE * float(np.median(new))
    return [
        f"The mean fitness went from {number(late)} (last quarter of {before.name}) to "
        f"{number(middle)} ({after.name}), so it {'rose' if middle > late else 'did not rise'}.",
        f"The curve {'collapsed at least once' if fell else 'never collapsed'}.",
    ]


def _pooled(experiment: Experiment) -> Floats:
    """The fitness curve as the mean over seeds, as long as the shortest."""
    curves = [curve_of(run, "fitness")[1] for run in experiment.runs]
    length = min(len(curve) for curve in curves)
    means: Floats = np.mean([curve[:length] for curve in curves], axis=0)
    return means


def kept_share(found: Sequence[Kept], world: str) -> str:
    """How much of a corridor is left after learning another one."""
    shares = np.array([entry.share for entry in found])
    return f"The network kept {spread(100 * shares)} % of its mean way between bumps in {world}."
