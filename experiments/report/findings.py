"""Sentences about what was seen. Fixed rules turn numbers into words, for and against the thesis.

The thesis shows single runs (E37): "as in the thesis" is about the shape, never about a number.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from experiments.drives.traces import Trace
from experiments.plans.presentation import Expected, Presentation
from experiments.report.figures.drives import Compared
from experiments.report.figures.progress import curve_of
from experiments.report.measures import (
    Kept,
    evaluated,
    longest_run,
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
ENOUGH_SEEDS = 8
"""Bootstrap intervals are far too narrow if either experiment has fewer seeds."""


def _verdict(same: bool) -> str:
    return "as in the thesis" if same else "unlike in the thesis"


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


def loss(experiment: Experiment, shown: Presentation) -> list[str]:
    """Loss before and after the first fitting phase; without one, at the beginning and the end."""
    sides = [side for run in experiment.runs if (side := _loss_sides(run)) is not None]
    if not sides:
        return []
    before, after = (np.array(values) for values in zip(*sides, strict=True))
    ratio = float(np.median(after / before))
    fits = any(np.any(run.episodes.numbers("fitting") > 0) for run in experiment.runs)
    when = "From before to after the first fitting phase" if fits else "From first to last"
    told = f"{when}, the mean loss went from {spread(before)} to {spread(after)}, so it "
    told += "fell" if ratio < 1.0 else "did not fall"
    if (falls := shown.expected.loss_falls) is not None:
        figure = shown.figures.get("loss")
        told += f", {_verdict((ratio < 1.0) == falls)}" + (f" ({figure})" if figure else "")
    return [told + "."]


def _loss_sides(run: RunFolder) -> tuple[float, float] | None:
    places, means = curve_of(run, "loss")
    fits = run.episodes.numbers("episode")[run.episodes.numbers("fitting") > 0]
    if not len(fits):
        return (float(means[0]), float(means[-1])) if len(means) > 1 else None
    before, after = means[places < fits[0]], means[places > fits[0] + run.window]
    if not len(before) or not len(after):
        return None
    return float(before[-1]), float(np.median(after))


def memory(experiment: Experiment, expected: Expected) -> list[str]:
    """Shares of the actions at the end, and whether they are balanced in most seeds."""
    shares = {name: of_seeds(experiment, partial(_share, name)) for name in SHORT_NAMES}
    if not len(shares[SHORT_NAMES[0]]):
        return []
    middles = [float(np.median(values)) for values in shares.values()]
    together = np.stack(list(shares.values()))
    spans = np.ptp(together, axis=0)
    balanced = float(np.median(spans)) <= BALANCED
    told = ", ".join(
        f"{name} {100 * middle:.1f} %" for name, middle in zip(SHORT_NAMES, middles, strict=True)
    )
    word = "balanced" if balanced else "not balanced"
    thesis = expected.balanced
    end = "" if thesis is None else f", {_verdict(thesis == balanced)}"
    when = "At the end" if all(run.info.complete for run in experiment.runs) else "So far"
    seeds = f"{np.count_nonzero(spans <= BALANCED)} of {len(spans)} seeds"
    return [
        f"{when} the memory held {told} (medians of the seeds). It was {word}{end}. "
        f"It was balanced in {seeds}."
    ]


def _share(action: str, run: RunFolder) -> float:
    counts = {name: run.episodes.numbers(name)[-1:] for name in SHORT_NAMES}
    total = sum(float(values.sum()) for values in counts.values())
    return float(counts[action][0]) / total if total else float("nan")


def worlds_in_memory(experiment: Experiment, expected: Expected) -> list[str]:
    """Samples per corridor at the end, and whether one has more than another, as expected."""
    names = sorted({name for run in experiment.runs for name in run.samples_by_world})
    if len(names) < 2:
        return []
    last = {
        name: np.array([run.samples_by_world.get(name, np.zeros(1))[-1] for run in experiment.runs])
        for name in names
    }
    told = f"Samples at the end: {'; '.join(f'{n} {spread(v)}' for n, v in last.items())}"
    if expected.more_samples_of and {*expected.more_samples_of} <= last.keys():
        many, few = expected.more_samples_of
        more = bool(np.median(last[many]) > np.median(last[few]))
        told += f". It held {'more' if more else 'not more'} of {many} than of {few}, "
        told += _verdict(more)
    return [told + "."]


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


def difference(pair: Compared, better: str | None) -> str:
    """Who had fewer bumps, whether the interval excludes 0, and what the thesis expects.

    Args:
        pair: The two experiments.
        better: The one that the thesis found better, if it says so.
    """
    d = pair.difference
    fewer, other = (pair.ours, pair.theirs) if d.mean <= 0 else (pair.theirs, pair.ours)
    told = f"{fewer} had fewer bumps than {other} in {pair.world}, by {number(abs(d.mean))} per "
    told += "1,000 actions."
    if d.mean == 0:
        told = f"{fewer} and {other} had equally many bumps in {pair.world}."
    told += f" The interval of {pair.ours} − {pair.theirs} is {number(d.low)} to {number(d.high)} "
    told += f"({pair.seeds[0]} and {pair.seeds[1]} seeds)"
    few = min(pair.seeds) < ENOUGH_SEEDS
    told += " and excludes 0." if d.sure else " and includes 0, so it is undecided which is better."
    if d.sure and few:
        told += " With so few seeds this is only a hint."
    if better is not None:
        told += f" The thesis found {better} better"
        agrees = "and so it is here" if better == fewer else "but here it is not"
        told += f", {agrees}." if d.sure and not few else "."
    return told


def drive(trace: Trace, *, of_thesis: bool) -> str:
    """How long a drive was and how often it bumped; the drive of the thesis did not bump."""
    bumps = int(trace.bumps.sum())
    told = f"{len(trace.bumps)} actions, {bumps} bump{'' if bumps == 1 else 's'}"
    return f"{told}, {_verdict(bumps == 0)}." if of_thesis else f"{told}."


def tours(experiment: Experiment) -> list[str]:
    """How many test drives were full and without a bump, as the thesis's was (A45, Fig 4.20)."""
    told = []
    for run in experiment.runs:
        if not run.tours:
            continue
        passed = sum(tour.passed for tour in run.tours)
        clean = sum(not tour.bumps for tour in run.tours) - passed
        sentence = f"Seed {run.info.seed}: {passed} of {len(run.tours)} test drives were full and "
        sentence += "without a bump"
        sentence += f", {clean} more without a bump but not full" if clean else ""
        told.append(f"{sentence}. The thesis shows one drive, which was both.")
    return told


def fitness_order(
    experiments: Sequence[Experiment], shown: Mapping[str, Presentation]
) -> list[str]:
    """Highest mean fitness of each, and whether those lead that lead in the thesis."""
    best = {e.name: of_seeds(e, max_mean_fitness) for e in experiments}
    if not all(len(values) for values in best.values()):
        return []
    told = "; ".join(f"{name} {spread(values)}" for name, values in best.items())
    sentences = [f"Highest mean fitness: {told}."]
    middles = {name: float(np.median(values)) for name, values in best.items()}
    for name in middles:
        lower = [other for other in shown[name].expected.fitness_above if other in middles]
        if lower:
            above = middles[name] > max(middles[other] for other in lower)
            word = "is" if above else "is not"
            sentences.append(
                f"The median of {name} {word} above that of {' and of '.join(lower)}, "
                f"{_verdict(above)}."
            )
    return sentences


def continued(before: Experiment, after: Experiment, *, of_thesis: bool) -> list[str]:
    """Whether the fitness rose where a run goes on from another, and whether it collapsed (A40).

    In the thesis it rose and never collapsed; `of_thesis` tells whether that is compared.
    """
    old = _pooled(before)
    new = _pooled(after)
    if not len(old) or not len(new):
        return []
    late, middle = float(np.mean(old[-max(1, len(old) // 4) :])), float(np.mean(new))
    rose = middle > late
    fell = float(new.min()) < COLLAPSE * float(np.median(new))
    ends = [f", {_verdict(holds)}." if of_thesis else "." for holds in (rose, not fell)]
    return [
        f"The mean fitness went from {number(late)} (last quarter of {before.name}) to "
        f"{number(middle)} ({after.name}), so it {'rose' if rose else 'did not rise'}{ends[0]}",
        f"The curve {'collapsed at least once' if fell else 'never collapsed'}{ends[1]}",
    ]


def _pooled(experiment: Experiment) -> Floats:
    """The fitness curve as the mean over seeds, as long as the shortest."""
    curves = [curve_of(run, "fitness")[1] for run in experiment.runs]
    length = min(len(curve) for curve in curves)
    means: Floats = np.mean([curve[:length] for curve in curves], axis=0)
    return means


def kept_share(found: Sequence[Kept], world: str) -> list[str]:
    """How much of a corridor is left after learning another one."""
    shares = np.array([entry.share for entry in found])
    word = "at least half" if float(np.median(shares)) >= 0.5 else "less than half"
    return [
        f"The network kept {spread(100 * shares)} % of its mean way between bumps in {world}, "
        f"{word}."
    ]
