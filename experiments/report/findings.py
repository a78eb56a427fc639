"""What was seen, as sentences: fixed rules turn numbers into words, also where they contradict.

The thesis shows single runs (E37): "as in the thesis" is about the shape, never about a number.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from experiments.drives.traces import Trace
from experiments.report.figures.drives import Compared
from experiments.report.figures.progress import curve_of
from experiments.report.figures.style import ACTIONS
from experiments.report.measures import (
    Kept,
    evaluated,
    longest_run,
    max_mean_fitness,
    number,
    of_seeds,
    spread,
)
from experiments.report.run_folder import Experiment, Floats, Run

BALANCED = 0.05
"""Shares of the three actions that differ by at most this are called balanced."""
MUCH_CIRCLING = 0.2
COLLAPSE = 0.25
"""A mean fitness below this part of the median of its curve is called a collapse."""
EXPECTED_BALANCED = {"plus-normm": False, "plus-rmm": True}
"""Fig 4.6, Fig 4.11."""
EXPECTED_FEWER_BUMPS = {
    ("plus-rmm", "plus-normm"),
    ("plus-rmm", "plus-normm-fit"),
    ("plus-rmm-nopretrain", "plus-normm-fit"),
    ("plus-rmm-nopretrain", "plus-normm-fit-alone"),
    ("plus-minus", "plus-minus-normm"),
}
"""Which of two the thesis holds for the better one (4.3.2)."""


ENOUGH_SEEDS = 8
"""Fewer of either make bootstrap intervals far too narrow (`tests/unit/test_statistics.py`)."""


def _verdict(same: bool) -> str:
    return "as in the thesis" if same else "other than in the thesis"


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
    """The highest point of the curve, beside the thesis where it tells one."""
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
        return [f"The memories did not begin equal in seed {', '.join(differ)}."]
    return ["Of every seed, the memory began equal in all of them."] if fills else []


def loss(experiment: Experiment) -> list[str]:
    """Loss before and after the first fitting phase, or at first and at last without one."""
    sides = [side for run in experiment.runs if (side := _loss_sides(run)) is not None]
    if not sides:
        return []
    before, after = (np.array(values) for values in zip(*sides, strict=True))
    ratio = float(np.median(after / before))
    fits = any(np.any(run.episodes.numbers("fitting") > 0) for run in experiment.runs)
    when = "from before to after the first fitting phase" if fits else "from first to last"
    told = f"The mean loss went {when} from {spread(before)} to {spread(after)}: it "
    told += "fell" if ratio < 1.0 else "did not fall"
    if experiment.name == "plus-rmm":
        told += f", {_verdict(ratio < 1.0)} (Fig 4.9b)"
    return [told + "."]


def _loss_sides(run: Run) -> tuple[float, float] | None:
    places, means = curve_of(run, "loss")
    fits = run.episodes.numbers("episode")[run.episodes.numbers("fitting") > 0]
    if not len(fits):
        return (float(means[0]), float(means[-1])) if len(means) > 1 else None
    before, after = means[places < fits[0]], means[places > fits[0] + run.window]
    if not len(before) or not len(after):
        return None
    return float(before[-1]), float(np.median(after))


def memory(experiment: Experiment) -> list[str]:
    """Shares of the actions at the end, and whether they are balanced in most seeds."""
    shares = {name: of_seeds(experiment, partial(_share, name)) for name in ACTIONS}
    if not len(shares["forward"]):
        return []
    middles = [float(np.median(values)) for values in shares.values()]
    together = np.stack(list(shares.values()))
    spans = np.ptp(together, axis=0)
    balanced = float(np.median(spans)) <= BALANCED
    told = ", ".join(
        f"{name} {100 * middle:.1f} %" for name, middle in zip(ACTIONS, middles, strict=True)
    )
    word = "balanced" if balanced else "not balanced"
    expected = EXPECTED_BALANCED.get(experiment.name)
    end = "" if expected is None else f", {_verdict(expected == balanced)}"
    when = "At the end" if all(run.info.complete for run in experiment.runs) else "So far"
    seeds = f"{np.count_nonzero(spans <= BALANCED)} of {len(spans)} seeds"
    return [
        f"{when} the memory held {told} (medians of the seeds): {word}{end}; balanced in {seeds}."
    ]


def _share(action: str, run: Run) -> float:
    counts = {name: run.episodes.numbers(name)[-1:] for name in ACTIONS}
    total = sum(float(values.sum()) for values in counts.values())
    return float(counts[action][0]) / total if total else float("nan")


def worlds_in_memory(experiment: Experiment) -> list[str]:
    """Samples per corridor at the end; after Plus-Minus the thesis has more of Minus (Fig 4.15)."""
    names = sorted({name for run in experiment.runs for name in run.samples_by_world})
    if len(names) < 2:
        return []
    last = {
        name: np.array([run.samples_by_world.get(name, np.zeros(1))[-1] for run in experiment.runs])
        for name in names
    }
    told = f"Samples at the end: {'; '.join(f'{n} {spread(v)}' for n, v in last.items())}"
    if experiment.name == "plus-minus" and {"plus", "minus"} <= last.keys():
        more = bool(np.median(last["minus"]) > np.median(last["plus"]))
        word = "more" if more else "not more"
        told += f": {word} of Minus than of Plus, {_verdict(more)}"
    return [told + "."]


def evaluation(experiment: Experiment, world: str) -> list[str]:
    """The newest drive of the frozen network beside floor and ceiling, circling told aloud."""
    bumps = of_seeds(experiment, evaluated("bumps_per_1000", world))
    if not len(bumps):
        return []
    laps, distance, coverage, circling = (
        of_seeds(experiment, evaluated(column, world))
        for column in ("laps", "distance", "coverage", "circling")
    )
    told = f"Frozen in {world}: {spread(bumps)} bumps and {spread(laps)} laps per 1,000 actions, "
    told += f"on average {spread(distance)} of the farthest possible from 50 actions ago, "
    told += f"{spread(coverage)} of the corridor visited"
    for driver in ("random", "planner"):
        other = of_seeds(experiment, evaluated("bumps_per_1000", world, driver))
        if len(other):
            told += f"; {driver}: {number(float(np.median(other)))} bumps"
    sentences = [told + "."]
    much = int(np.sum(circling > MUCH_CIRCLING))
    if much:
        sentences.append(
            f"Mind the circling in {world}, {spread(100 * circling)} % of the time: {much} of "
            f"{len(circling)} seeds circle more than {100 * MUCH_CIRCLING:.0f} % of it, so few "
            "bumps or a high fitness do not mean that they get anywhere."
        )
    return sentences


def difference(pair: Compared) -> str:
    """Who had fewer bumps, whether the interval excludes 0, and what the thesis expects."""
    d = pair.difference
    fewer, other = (pair.ours, pair.theirs) if d.mean <= 0 else (pair.theirs, pair.ours)
    told = f"{fewer} had fewer bumps than {other} in {pair.world}: "
    if d.mean == 0:
        told = f"{fewer} and {other} had equally many bumps in {pair.world}: "
    told += f"{number(abs(d.mean))} per 1,000 actions; the interval of {pair.ours} − {pair.theirs} "
    told += f"is {number(d.low)} to {number(d.high)} ({pair.seeds[0]} and {pair.seeds[1]} seeds), "
    few = min(pair.seeds) < ENOUGH_SEEDS
    told += "which excludes 0" if d.sure else "which includes 0: undecided"
    if d.sure and few:
        told += ", a hint only: of so few seeds many do by chance"
    better = _expected_better(pair.ours, pair.theirs)
    if better is not None and d.sure and not few:
        told += f"; the thesis holds {better} for the better one: "
        told += "so it is here" if better == fewer else "here it is not"
    elif better is not None:
        told += f"; the thesis holds {better} for the better one"
    return told + "."


def _expected_better(ours: str, theirs: str) -> str | None:
    if (ours, theirs) in EXPECTED_FEWER_BUMPS:
        return ours
    return theirs if (theirs, ours) in EXPECTED_FEWER_BUMPS else None


def drive(trace: Trace, *, of_thesis: bool) -> str:
    """How long a drive was and how often it bumped; in the thesis's test it did not (Fig 4.20)."""
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
        told.append(f"{sentence}; the only one that the thesis tells of was both.")
    return told


def policies(experiments: Sequence[Experiment]) -> list[str]:
    """Whether every eps-greedy policy got farther than every roulette (Fig 4.2)."""
    best = {e.name: of_seeds(e, max_mean_fitness) for e in experiments}
    middles = {name: float(np.median(values)) for name, values in best.items() if len(values)}
    greedy = [value for name, value in middles.items() if "eps-greedy" in name]
    rest = [value for name, value in middles.items() if "eps-greedy" not in name]
    if not greedy or not rest:
        return []
    above = min(greedy) > max(rest)
    told = "Every policy that is greedy most of the time got" if above else "Not every policy that"
    told += " farther" if above else " is greedy most of the time got farther"
    return [f"{told} than roulette alone, {_verdict(above)}."]


def continued(before: Experiment, after: Experiment) -> list[str]:
    """Whether fitting phases raised the fitness, and whether it collapsed (A40)."""
    old = _pooled(before)
    new = _pooled(after)
    if not len(old) or not len(new):
        return []
    late, middle = float(np.mean(old[-max(1, len(old) // 4) :])), float(np.mean(new))
    rose = middle > late
    fell = float(new.min()) < COLLAPSE * float(np.median(new))
    return [
        f"The mean fitness went from {number(late)} (last quarter of {before.name}) to "
        f"{number(middle)} ({after.name}): it {'rose' if rose else 'did not rise'}, "
        f"{_verdict(rose)}.",
        f"The curve {'collapsed at least once' if fell else 'never collapsed'}, "
        f"{_verdict(not fell)}.",
    ]


def _pooled(experiment: Experiment) -> Floats:
    """The fitness curve as the mean over seeds, as long as the shortest."""
    curves = [curve_of(run, "fitness")[1] for run in experiment.runs]
    length = min(len(curve) for curve in curves)
    means: Floats = np.mean([curve[:length] for curve in curves], axis=0)
    return means


def fitted(rmm: Sequence[Experiment], normm: Experiment) -> list[str]:
    """Highest fitness of RMM with fits beside NoRMM with fits (Fig 4.12)."""
    all_of = [*rmm, normm]
    best = {e.name: of_seeds(e, max_mean_fitness) for e in all_of}
    if not all(len(values) for values in best.values()):
        return []
    told = "; ".join(f"{name} {spread(values)}" for name, values in best.items())
    above = min(float(np.median(best[e.name])) for e in rmm) > float(np.median(best[normm.name]))
    word = "every RMM run's is above NoRMM's" if above else "not every RMM run's is above NoRMM's"
    return [f"Highest mean fitness: {told}. Of the medians {word}, {_verdict(above)}."]


def kept_share(found: Sequence[Kept], world: str) -> list[str]:
    """How much of a corridor is left after learning another one."""
    shares = np.array([entry.share for entry in found])
    word = "it kept at least half" if float(np.median(shares)) >= 0.5 else "it lost more than half"
    left = f"{spread(100 * shares)} %"
    return [f"Of its mean way without a bump in {world}, {left} was left: {word}."]
