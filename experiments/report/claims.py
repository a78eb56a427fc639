"""What the thesis claims, claim by claim: supported, contradicted or undecided by our runs.

Plans say what is claimed of them (`report.claims`). A claim is looked at in every seed. It is
supported if it surely holds in more than half of all seeds that there could be, contradicted if it
surely does not: the whole 95 % interval (Wilson) of the share of seeds lies on one side of a half.
That takes at least four seeds that agree.
"""

from collections.abc import Mapping, Sequence
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
HEADER = ("claim", "where", "verdict", "seeds in which it holds", "figure", "command")
TOLD = {
    "bumps-beside": "bumps divided by those of the other",
    "rarer-direction": "laps per 1,000 actions in the rarer direction",
    "unbalance": "largest minus smallest share of an action in the memory",
    "lowest-fitness": "lowest mean fitness as a part of the median",
    "kept": "way between bumps, after the other corridor over before",
    "samples-beside": "samples of the first corridor for each of the second",
    "highest-threshold": "highest threshold (%)",
    "highest-capacity": "highest capacity, as large as in the thesis",
    "clean-tours": "test drives that were full and without a bump",
    "fitness-beside": "highest mean fitness over that of the lowest other",
    "loss-after-fit": "loss after the first fit over before",
}
"""What the figure of a seed is called."""


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
            name, title = f"claims-{scale}", f"Claims of the thesis at scale {scale}"
            sections.append(Section(name, title, (Table(name, title, HEADER, tuple(rows)),)))
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
    found = (_figure(claim, run, runs) for run in experiment.runs)
    values = np.array([value for value in found if isfinite(value)], np.float64)
    text = TOLD[claim.figure]
    return (
        claim.text,
        claim.source,
        *judged(sum(holds(claim, float(value)) for value in values), len(values)),
        f"{text}: {spread(values)}" if len(values) else text,
        f"`corridor experiment {experiment.name} --scale {experiment.scale}`",
    )


def _figure(claim: Claim, run: RunFolder, runs: Runs) -> float:
    """The figure of a seed. NaN: it is not known."""
    others = (each for name in claim.others if name in runs for each in runs[name].runs)
    beside = [each for each in others if each.info.seed == run.info.seed]
    match claim.figure:
        case "bumps-beside":
            rates = [_at_end(each, claim, "bumps") + 0.5 for each in (run, *beside)]
            return rates[0] / rates[1] if len(rates) == 2 else MISSING
        case "rarer-direction":
            sides = ("laps_left_per_1000", "laps_right_per_1000")
            return min(_at_end(run, claim, side) for side in sides)
        case "lowest-fitness":
            curve = curve_of(run, "fitness")[1]
            return float(curve.min() / np.median(curve)) if len(curve) else MISSING
        case "kept":
            found = kept(run, claim.worlds[0], None)
            return found.share if found else MISSING
        case "clean-tours":
            return float(sum(tour.passed for tour in run.tours)) if run.tours else MISSING
        case "fitness-beside":
            complete = len(beside) == len(claim.others)
            lowest = min(map(max_mean_fitness, beside)) if complete else MISSING
            return max_mean_fitness(run) / lowest
        case "loss-after-fit":
            return loss_ratio(run)
        case _:
            return _of_memory(claim, run) if run.info.complete else MISSING


def _of_memory(claim: Claim, run: RunFolder) -> float:
    """A figure of the memory, which is known of a complete run only."""
    if claim.figure == "highest-threshold":
        return highest(run, "threshold_percent")
    if claim.figure == "highest-capacity":
        return highest(run, "capacity") * run.info.factor
    if claim.figure == "samples-beside":
        ours, theirs = (run.samples_by_world.get(name, [MISSING])[-1] for name in claim.worlds)
        return float(ours / max(theirs, 1.0))
    counts = np.array([run.episodes.numbers(name)[-1:] for name in SHORT_NAMES], np.float64)
    return float(np.ptp(counts) / counts.sum()) if counts.size else MISSING


def _at_end(run: RunFolder, claim: Claim, column: str) -> float:
    """A column of the frozen drive in the first corridor of a claim, at the end of its stage."""
    rows = run.evaluated(claim.worlds[0])
    if claim.stage:
        rows = rows.where(label=f"stage {claim.stage}")
    return float(rows.numbers(column)[-1]) if len(rows) else MISSING
