"""Sentences about what was seen: fixed rules turn numbers into words.

What the thesis says, and whether it holds, stands in the table of claims (`claims`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from experiments.drives.traces import Trace
from experiments.report.measures import (
    Kept,
    evaluated,
    longest_run,
    max_mean_fitness,
    number,
    of_seeds,
    spread,
)
from experiments.report.run_folder import Experiment

MUCH_CIRCLING = 0.2


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


def kept_share(found: Sequence[Kept], world: str) -> str:
    """How much of a corridor is left after learning another one."""
    shares = np.array([entry.share for entry in found])
    return f"The network kept {spread(100 * shares)} % of its mean way between bumps in {world}."
