"""Rates of bumps compared seed by seed: tables, a figure and sentences (docs/comparison.md)."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from experiments.report.document import Block, Findings, Missing, Picture, Table, table
from experiments.report.figures.style import GREY, INK, sheet, styled
from experiments.report.measures import number
from experiments.report.run_folder import Experiment, Rows, RunFolder
from experiments.verdicts import MARGIN, Floats, Paired, holm, log_rates, paired

Drives = Mapping[int, tuple[float, float]]
"""Bumps and actions of frozen drives by seed."""


class Ratio(NamedTuple):
    """Two strategies compared in one corridor."""

    ours: str
    theirs: str
    world: str
    paired: Paired
    p: float
    """Corrected for the number of comparisons."""


def newest_drives(experiment: Experiment, world: str, label: str = "") -> Drives:
    """Bumps and actions of the newest frozen drives, by seed: of all, or of those of a label."""
    only = {"label": label} if label else {}
    runs = experiment.runs
    return _drives({run.info.seed: run.evaluated(world).where(**only) for run in runs})


def drives_at_equal_actions(
    ours: Experiment, theirs: Experiment, named: Mapping[str, Experiment], world: str
) -> tuple[Drives, Drives]:
    """Newest frozen drives of both, by seed, up to as many actions as the one that drove less.

    named: Experiments by name, among them those that the two go on from: their drives and actions
        come before.
    """
    mine, other = (
        {run.info.seed: _with_before(run, named, world) for run in each.runs}
        for each in (ours, theirs)
    )
    for seed in mine.keys() & other.keys():
        both = (mine[seed], other[seed])
        end = min(rows.numbers("total_actions").max(initial=-1.0) for rows in both)
        mine[seed], other[seed] = (
            Rows(tuple(row for row in rows.rows if float(row["total_actions"]) <= end))
            for rows in both
        )
    return _drives(mine), _drives(other)


def _with_before(run: RunFolder, named: Mapping[str, Experiment], world: str) -> Rows:
    """Frozen drives, predecessors' first."""
    rows = run.evaluated(world)
    for before in named[run.info.after].runs if run.info.after in named else ():
        if before.info.seed == run.info.seed:
            rows = Rows(_with_before(before, named, world).rows + rows.rows)
    return rows


def _drives(rows: Mapping[int, Rows]) -> Drives:
    """Bumps and actions of each seed's last drive."""
    return {
        seed: (float(each.rows[-1]["bumps"]), float(each.rows[-1]["actions"]))
        for seed, each in rows.items()
        if len(each)
    }


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
    """Compare one strategy with others by their drives in a world, corrected by Holm's method.

    Others with fewer than 2 common seeds are left out.
    """
    found: dict[str, Paired] = {}
    for other in others:
        seeds = common_seeds(drives.get(ours, {}), drives.get(other, {}))
        if len(seeds) > 1:
            found[other] = paired(logs(drives[ours], seeds), logs(drives[other], seeds))
    corrected = holm({name: each.p for name, each in found.items()})
    return [Ratio(ours, name, world, each, corrected[name]) for name, each in found.items()]


def ratio_blocks(
    name: str, title: str, found: Sequence[Ratio], more: Sequence[str] = ()
) -> list[Block]:
    """Table, sentences and figure of comparisons, or why there are none; `more` sentences."""
    if not found:
        return [Missing(title, "fewer than two seeds of both were run")]
    caption = "Bumps of the first divided by those of the other, seed by seed."
    return [
        ratio_table(name, title, found),
        Findings((*(_told(*each[:4]) for each in found), *more)),
        Picture(f"{name}-figure", title, caption, partial(ratio_figure, found)),
    ]


def ratio_table(name: str, title: str, found: Sequence[Ratio]) -> Table:
    """One row for each comparison."""
    return table(name, title, found, {
        "compared": lambda each: f"{each.ours} / {each.theirs}",
        "corridor": lambda each: each.world,
        "seeds": lambda each: str(each.paired.seeds),
        "ratio of bumps": lambda each: number(each.paired.ratio),
        "95 % interval": lambda each: f"{number(each.paired.low)} to {number(each.paired.high)}",
        "p": lambda each: f"{each.p:.3f}",
        "verdict": lambda each: each.paired.verdict
        + ("" if each.paired.not_inferior else ", may be inferior"),
        "seeds to decide": lambda each: f"about {each.paired.needed:,}"
        if each.paired.verdict == "undecided" else "-",
    })  # fmt: skip


def _told(ours: str, theirs: str, world: str, pair: Paired) -> str:
    """A comparison as a sentence."""
    interval = f"{number(pair.ratio)} times ({number(pair.low)} to {number(pair.high)})"
    return f"In {world}, {ours} bumps {interval} as often as {theirs}: {_WORDS[pair.verdict]}."


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
    names = [f"{each.ours} / {each.theirs} ({each.world})" for each in found]
    axes.set_yticks(range(len(names) - 1, -1, -1), names)
    axes.set_ylim(-0.6, len(names) - 0.4)
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("ratio of bumps, 95 % interval; grey: counts as equal")
    return figure
