"""Drives of frozen networks: curves over actions."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from experiments.report.figures.style import GREY, colours, draw_band, sheet, styled
from experiments.report.run_folder import Experiment, Floats, Rows
from experiments.report.statistics import Curve, band_between

REFERENCES = {"random": ":", "planner": "--"}
"""Line styles of the floor and the ceiling."""


class Panel(NamedTuple):
    """One of the figures side by side."""

    title: str
    columns: tuple[str, ...]
    """Columns of `evaluations.csv` whose sum is shown."""
    logarithmic: bool = False

    def of(self, rows: Rows) -> Floats:
        """The figure of every drive."""
        return np.asarray(np.sum([rows.numbers(column) for column in self.columns], axis=0))


BUMPS = Panel("bumps per 1,000 actions", ("bumps_per_1000",), logarithmic=True)
LAPS = Panel("laps per 1,000 actions", ("laps_left_per_1000", "laps_right_per_1000"))
COVERAGE = Panel("part of the corridor visited", ("coverage",))
DISTANCE = Panel("way from 50 actions ago\n(1: the farthest possible)", ("distance",))


def panels(experiments: Sequence[Experiment], world: str) -> tuple[Panel, Panel, Panel]:
    """Bumps, whether it gets around, and how far: coverage where nobody drove a lap."""
    rows = [run.evaluations.where(world=world) for e in experiments for run in e.runs]
    around = LAPS if any(np.any(LAPS.of(part) > 0) for part in rows) else COVERAGE
    return BUMPS, around, DISTANCE


def _curves_of(experiment: Experiment, world: str, panel: Panel) -> list[Curve]:
    """One figure of every seed that drove, over the actions driven while learning.

    Of several drives after the same number of actions the last one counts.
    """
    found = []
    for rows in (run.evaluated(world) for run in experiment.runs):
        if len(rows):
            x, y = rows.numbers("total_actions"), panel.of(rows)
            last = np.append(x[1:] != x[:-1], True)
            found.append((x[last], y[last]))
    return found


@styled
def curves(experiments: Sequence[Experiment], world: str) -> Figure:
    """Bumps, laps or coverage, and distance of frozen greedy drives in one corridor."""
    figure = sheet(2.75 + 0.2 * (len(experiments) // 3))
    named = colours(experiment.name for experiment in experiments)
    row = figure.subplots(1, 3)
    for panel, axes in zip(panels(experiments, world), row, strict=True):
        for experiment in experiments:
            # Seeds drive different numbers of actions: single ones go on beyond the band.
            found = _curves_of(experiment, world, panel)
            for curve in found:
                axes.plot(*curve, color=named[experiment.name], linewidth=0.7, alpha=0.6)
            if found:
                draw_band(axes, band_between(found), named[experiment.name], experiment.name)
        for driver, style in REFERENCES.items():
            drives = (r.evaluations.where(driver=driver, world=world) for e in experiments
                      for r in e.runs)  # fmt: skip
            heights = np.concatenate([panel.of(rows) for rows in drives])
            if len(heights):
                middle = float(np.median(heights))
                axes.axhline(middle, color=GREY, linestyle=style, linewidth=1.1, label=driver)
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
