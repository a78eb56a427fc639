"""What the thesis claims, claim by claim: supported, contradicted or undecided by our runs.

Plans say what is claimed of them (`report.claims`). A claim is looked at in every seed. It is
supported if it surely holds in more than half of all seeds that there could be, contradicted if it
surely does not: the whole 95 % interval (Wilson) of the share of seeds lies on one side of a half.
That takes at least four seeds that agree.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import inf, isfinite

import numpy as np
from scipy import stats

from experiments.plans.presentation import Claim, Presentation
from experiments.report.document import Section, Table
from experiments.report.figures.progress import curve_of
from experiments.report.measures import (
    MISSING,
    highest,
    kept,
    loss_ratio,
    max_mean_fitness,
    number,
    spread,
)
from experiments.report.run_folder import Experiment, RunFolder
from shared.facts import SHORT_NAMES

Runs = Mapping[str, Experiment]
"""Experiments of one scale by name."""


def claims_sections(
    experiments: Sequence[Experiment], shown: Mapping[str, Presentation]
) -> list[Section]:
    """A section for every scale at which something was run of which the thesis claims something."""
    sections = []
    for scale in sorted({experiment.scale for experiment in experiments}):
        runs = {each.name: each for each in experiments if each.scale == scale}
        rows = [
            _row(claim, runs[name], runs) for name in sorted(runs) for claim in shown[name].claims
        ]
        if rows:
            header = ("claim", "where", "verdict", "seeds in which it holds", "figure", "command")
            title = f"Claims of the thesis at scale {scale}"
            table = Table(f"claims-{scale}", title, header, tuple(rows))
            sections.append(Section(f"claims-{scale}", title, (table,)))
    return sections


def judged(held: int, seeds: int) -> tuple[str, str]:
    """Verdict on a claim that held in so many of these seeds, and the number with its interval."""
    if not seeds:
        return "not run", "0 of 0"
    found = stats.binomtest(held, seeds).proportion_ci(0.95, method="wilson")
    verdict = "supported" if found.low > 0.5 else "undecided"
    told = f"{held} of {seeds} ({number(100 * found.low)} to {number(100 * found.high)} %)"
    return "contradicted" if found.high < 0.5 else verdict, told


def holds(claim: Claim, value: float) -> bool:
    """Whether a claim holds in a seed with this figure."""
    least, most = claim.least, claim.most
    return (-inf if least is None else least) <= value <= (inf if most is None else most)


def _row(claim: Claim, experiment: Experiment, runs: Runs) -> tuple[str, ...]:
    text, measure = _FIGURES[claim.figure]
    found = (measure(run, claim, runs) for run in experiment.runs)
    values = np.array([value for value in found if isfinite(value)], np.float64)
    return (
        claim.text,
        claim.source,
        *judged(sum(holds(claim, float(value)) for value in values), len(values)),
        f"{text}: {spread(values)}" if len(values) else text,
        f"`corridor experiment {experiment.name} --scale {experiment.scale}`",
    )


# ---------------------------------------------------------------- figures of a seed


def _bumps_beside(run: RunFolder, claim: Claim, runs: Runs) -> float:
    rates = [_at_end(each, claim, "bumps") + 0.5 for each in (run, *_beside(run, claim, runs))]
    return rates[0] / rates[1] if len(rates) == 2 else MISSING


def _rarer_direction(run: RunFolder, claim: Claim, _: Runs) -> float:
    sides = ("laps_left_per_1000", "laps_right_per_1000")
    return min(_at_end(run, claim, side) for side in sides)


def _unbalance(run: RunFolder, _: Claim, __: Runs) -> float:
    counts = np.array([run.episodes.numbers(name)[-1:] for name in SHORT_NAMES], np.float64)
    told = run.info.complete and counts.size and np.all(np.isfinite(counts))
    return float(np.ptp(counts) / counts.sum()) if told else MISSING


def _lowest_fitness(run: RunFolder, _: Claim, __: Runs) -> float:
    curve = curve_of(run, "fitness")[1]
    return float(curve.min() / np.median(curve)) if len(curve) else MISSING


def _kept(run: RunFolder, claim: Claim, _: Runs) -> float:
    found = kept(run, claim.worlds[0], None)
    return found.share if found else MISSING


def _samples_beside(run: RunFolder, claim: Claim, _: Runs) -> float:
    counts = [run.samples_by_world[name] for name in claim.worlds if name in run.samples_by_world]
    if not run.info.complete or len(counts) < 2:
        return MISSING
    return float(counts[0][-1] / max(counts[1][-1], 1.0))


def _highest(run: RunFolder, column: str) -> float:
    return highest(run, column) if run.info.complete else MISSING


def _clean_tours(run: RunFolder, _: Claim, __: Runs) -> float:
    return float(sum(tour.passed for tour in run.tours)) if run.tours else MISSING


def _fitness_beside(run: RunFolder, claim: Claim, runs: Runs) -> float:
    others = [max_mean_fitness(each) for each in _beside(run, claim, runs)]
    complete = len(others) == len(claim.others)
    return max_mean_fitness(run) / min(others) if complete else MISSING


def _at_end(run: RunFolder, claim: Claim, column: str) -> float:
    """A column of the frozen drive in the first corridor of a claim, at the end of its stage."""
    rows = run.evaluated(claim.worlds[0])
    if claim.stage:
        rows = rows.where(label=f"stage {claim.stage}")
    return float(rows.numbers(column)[-1]) if len(rows) else MISSING


def _beside(run: RunFolder, claim: Claim, runs: Runs) -> list[RunFolder]:
    """The runs of the other experiments with the same seed."""
    others = (each for name in claim.others if name in runs for each in runs[name].runs)
    return [each for each in others if each.info.seed == run.info.seed]


_FIGURES: Mapping[str, tuple[str, Callable[[RunFolder, Claim, Runs], float]]] = {
    "bumps-beside": ("bumps divided by those of the other", _bumps_beside),
    "rarer-direction": ("laps per 1,000 actions in the rarer direction", _rarer_direction),
    "unbalance": ("largest minus smallest share of an action in the memory", _unbalance),
    "lowest-fitness": ("lowest mean fitness as a part of the median", _lowest_fitness),
    "kept": ("way between bumps, after the other corridor over before", _kept),
    "samples-beside": ("samples of the first corridor for each of the second", _samples_beside),
    "highest-threshold": (
        "highest threshold (%)", lambda run, _, __: _highest(run, "threshold_percent"),
    ),
    "highest-capacity": (
        "highest capacity, as large as in the thesis",
        lambda run, _, __: _highest(run, "capacity") * run.info.factor,
    ),
    "clean-tours": ("test drives that were full and without a bump", _clean_tours),
    "fitness-beside": ("highest mean fitness over that of the lowest other", _fitness_beside),
    "loss-after-fit": ("loss after the first fit over before", lambda run, _, __: loss_ratio(run)),
}  # fmt: skip
"""What the figure of a seed is called, and how it is found. NaN: it is not known."""
