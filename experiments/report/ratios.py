"""Rates of bumps compared seed by seed: tables, a figure and sentences (docs/comparison.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from experiments.report.document import Table
from experiments.report.figures.style import GREY, INK, label_rows, sheet, styled
from experiments.report.measures import number
from experiments.report.run_folder import Experiment
from experiments.verdicts import MARGIN, Floats, Paired, holm, log_rates, paired

Drives = Mapping[int, tuple[float, float]]
"""Bumps and actions of frozen drives by seed."""


@dataclass(frozen=True)
class Ratio:
    """Two strategies compared in one corridor."""

    ours: str
    theirs: str
    world: str
    paired: Paired
    p: float
    """Corrected for the number of comparisons."""


def stage_drives(experiment: Experiment, stage: str, world: str) -> Drives:
    """Bumps and actions of the frozen drives at the end of a stage, by seed."""
    found = {}
    for run in experiment.runs:
        rows = run.evaluated(world).where(label=f"stage {stage}")
        if len(rows):
            bumps, actions = rows.numbers("bumps")[-1], rows.numbers("actions")[-1]
            found[run.info.seed] = (float(bumps), float(actions))
    return found


def logs(drives: Drives, seeds: Sequence[int]) -> Floats:
    """Logarithms of the rates of these seeds: float64 [n]."""
    counts = np.array([drives[seed] for seed in seeds], np.float64).reshape(-1, 2)
    return log_rates(counts[:, 0], counts[:, 1])


def common_seeds(ours: Drives, theirs: Drives) -> list[int]:
    """Seeds that both have, ascending."""
    return sorted(ours.keys() & theirs.keys())


def ratios(
    ours: str, others: Sequence[str], world: str, drives: Mapping[str, Drives]
) -> list[Ratio]:
    """Compare one strategy with others, corrected by Holm's method.

    Others with fewer than 2 common seeds are left out.

    Args:
        ours: Name of one.
        others: Names of those it is compared with.
        world: Where they drove.
        drives: Of all of them, by name.
    """
    found: dict[str, Paired] = {}
    for other in others:
        seeds = common_seeds(drives.get(ours, {}), drives.get(other, {}))
        if len(seeds) > 1:
            found[other] = paired(logs(drives[ours], seeds), logs(drives[other], seeds))
    corrected = holm({name: each.p for name, each in found.items()})
    return [Ratio(ours, name, world, each, corrected[name]) for name, each in found.items()]


def ratio_table(name: str, title: str, found: Sequence[Ratio]) -> Table:
    """One row for each comparison."""
    header = (
        "compared", "corridor", "seeds", "ratio of bumps", "95 % interval", "p", "verdict",
        "seeds to decide",
    )  # fmt: skip
    rows = tuple(
        (
            f"{each.ours} / {each.theirs}",
            each.world,
            str(each.paired.seeds),
            number(each.paired.ratio),
            f"{number(each.paired.low)} to {number(each.paired.high)}",
            f"{each.p:.3f}",
            each.paired.verdict + ("" if each.paired.not_inferior else ", may be inferior"),
            "-" if each.paired.verdict != "undecided" else f"about {each.paired.needed:,}",
        )
        for each in found
    )
    return Table(name, title, header, rows)


def told(found: Sequence[Ratio]) -> list[str]:
    """A sentence for each comparison."""
    sentences = []
    for each in found:
        pair = each.paired
        interval = f"{number(pair.ratio)} times ({number(pair.low)} to {number(pair.high)})"
        said = f"In {each.world}, {each.ours} bumps {interval} as often as {each.theirs}"
        sentences.append(f"{said}: {_WORDS[pair.verdict]}.")
    return sentences


_WORDS = {
    "better": "it is better",
    "worse": "it is worse",
    "equal": f"they count as equal, because the whole interval lies within 1/{MARGIN} to {MARGIN}",
    "undecided": "that decides nothing",
}


@styled
def ratio_figure(found: Sequence[Ratio]) -> Figure:
    """A line for each comparison: ratio and interval on a logarithmic scale, filled if decided."""
    figure = sheet(1.0 + 0.3 * len(found))
    axes = figure.subplots()
    axes.axvspan(1.0 / MARGIN, MARGIN, color="#eeeeee", zorder=0)
    for row, each in enumerate(found):
        at, pair = len(found) - 1 - row, each.paired
        axes.plot([pair.low, pair.high], [at, at], color=INK)
        face = "white" if pair.verdict == "undecided" else INK
        axes.plot(pair.ratio, at, "o", color=INK, markerfacecolor=face)
    axes.axvline(1.0, color=GREY, linestyle="--", linewidth=1.0)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    label_rows(axes, [f"{each.ours} / {each.theirs} ({each.world})" for each in found])
    axes.set_xlabel("ratio of bumps, 95 % interval; grey: counts as equal")
    return figure
