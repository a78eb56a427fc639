"""Drives of frozen networks: curves over actions, and differences between experiments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from experiments.report.figures.style import (
    GREY,
    INK,
    colours,
    draw_band,
    label_rows,
    sheet,
    styled,
)
from experiments.report.run_folder import Experiment, Floats, Rows
from experiments.report.statistics import Band, Difference, band_between

REFERENCES = {"random": ":", "planner": "--"}
"""Line styles of the floor and the ceiling."""


def laps(rows: Rows) -> Floats:
    """Laps per 1,000 actions, in either direction."""
    return rows.numbers("laps_left_per_1000") + rows.numbers("laps_right_per_1000")


def _bumps(rows: Rows) -> Floats:
    return rows.numbers("bumps_per_1000")


def _distance(rows: Rows) -> Floats:
    return rows.numbers("distance")


def _coverage(rows: Rows) -> Floats:
    return rows.numbers("coverage")


@dataclass(frozen=True)
class Panel:
    """One of the figures side by side."""

    title: str
    of: Callable[[Rows], Floats]
    logarithmic: bool = False


BUMPS = Panel("bumps per 1,000 actions", _bumps, logarithmic=True)
LAPS = Panel("laps per 1,000 actions", laps)
COVERAGE = Panel("part of the corridor visited", _coverage)
DISTANCE = Panel("way from 50 actions ago\n(1: the farthest possible)", _distance)


def panels(experiments: Sequence[Experiment], world: str) -> tuple[Panel, Panel, Panel]:
    """Bumps, whether it gets around, and how far: coverage where nobody drove a lap."""
    rows = [run.evaluations.where(world=world) for e in experiments for run in e.runs]
    around = LAPS if any(np.any(laps(part) > 0) for part in rows) else COVERAGE
    return BUMPS, around, DISTANCE


def evaluation_curves(
    experiment: Experiment, world: str, panel: Panel
) -> list[tuple[Floats, Floats]]:
    """One figure of every seed that drove over the actions driven while learning."""
    rows = [run.evaluated(world) for run in experiment.runs]
    return [_unique(part.numbers("total_actions"), panel.of(part)) for part in rows if len(part)]


def evaluation_band(experiment: Experiment, world: str, panel: Panel) -> Band | None:
    """The curves of all seeds together, where all of them drove; None without drives."""
    curves = evaluation_curves(experiment, world, panel)
    return band_between(curves) if curves else None


def _unique(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """The last of several drives after the same number of actions."""
    last = np.append(x[1:] != x[:-1], True)
    return x[last], y[last]


def reference(experiments: Sequence[Experiment], driver: str, world: str, panel: Panel) -> float:
    """Median over all seeds of what a driver without a network reaches; NaN if none drove."""
    values = [
        value
        for experiment in experiments
        for run in experiment.runs
        for value in panel.of(run.evaluations.where(driver=driver, world=world))
    ]
    return float(np.median(values)) if values else float("nan")


@styled
def curves(experiments: Sequence[Experiment], world: str) -> Figure:
    """Bumps, laps or coverage, and distance of frozen greedy drives in one corridor."""
    figure = sheet(2.75 + 0.2 * (len(experiments) // 3))
    named = colours(experiment.name for experiment in experiments)
    row = figure.subplots(1, 3)
    for panel, axes in zip(panels(experiments, world), row, strict=True):
        for experiment in experiments:
            # Seeds drive different numbers of actions: single ones go on beyond the band.
            for curve in evaluation_curves(experiment, world, panel):
                axes.plot(*curve, color=named[experiment.name], linewidth=0.7, alpha=0.6)
            band = evaluation_band(experiment, world, panel)
            if band is not None:
                draw_band(axes, band, named[experiment.name], experiment.name)
        for driver, style in REFERENCES.items():
            height = reference(experiments, driver, world, panel)
            if not np.isnan(height):
                axes.axhline(height, color=GREY, linestyle=style, linewidth=1.1, label=driver)
        _panel(axes, panel)
    figure.legend(*row[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def _panel(axes: Axes, panel: Panel) -> None:
    axes.set_title(panel.title)
    axes.set_xlabel("actions driven while learning")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_major_locator(MaxNLocator(4))
    if panel.logarithmic:  # linear from 0 to 1: good networks stay apart, none is left out
        axes.set_yscale("symlog", linthresh=1.0)
        axes.set_yticks([0, 1, 3, 10, 30, 100], ["0", "1", "3", "10", "30", "100"])
        axes.minorticks_off()
    axes.set_ylim(bottom=0)


@dataclass(frozen=True)
class Compared:
    """Two experiments and the difference of their bumps per 1,000 actions in a corridor."""

    ours: str
    theirs: str
    world: str
    seeds: tuple[int, int]
    difference: Difference


@styled
def differences(pairs: Sequence[Compared]) -> Figure:
    """A line per pair: the difference and its interval, filled where it excludes 0."""
    figure = sheet(0.9 + 0.32 * len(pairs))
    axes = figure.subplots()
    for row, pair in enumerate(pairs):
        at, colour = len(pairs) - 1 - row, INK
        axes.plot([pair.difference.low, pair.difference.high], [at, at], color=colour)
        face = colour if pair.difference.sure else "white"
        axes.plot(pair.difference.mean, at, "o", color=colour, markerfacecolor=face)
    axes.axvline(0.0, color=GREY, linestyle="--", linewidth=1.0)
    label_rows(axes, [f"{pair.ours} − {pair.theirs} ({pair.world})" for pair in pairs])
    axes.set_xlabel("difference in bumps per 1,000 actions, 95 % interval")
    return figure
