"""Single numbers of runs, and how they are written."""

import math
from collections.abc import Callable
from itertools import dropwhile, takewhile
from typing import NamedTuple

import numpy as np

from experiments.drives.traces import FULL_RUN
from experiments.report.figures.drives import LAPS
from experiments.report.figures.progress import curve_of
from experiments.report.run_folder import Experiment, Floats, Rows, RunFolder

MISSING = float("nan")
Of = Callable[[RunFolder], float]


class Measure(NamedTuple):
    """A number of a run that the thesis tells as well."""

    text: str
    of: Of
    grows: bool = False
    """Whether it grows with the scale."""


def highest(run: RunFolder, column: str) -> float:
    """The largest number in a column of the episodes."""
    values = run.episodes.numbers(column)
    return float(np.nanmax(values)) if np.any(~np.isnan(values)) else MISSING


def max_mean_fitness(run: RunFolder) -> float:
    """Highest point of the fitness curve (A38)."""
    return float(np.max(curve_of(run, "fitness")[1], initial=-math.inf))


def loss_ratio(run: RunFolder) -> float:
    """Loss after the first fitting phase over that before it; without one, last over first."""
    places, means = curve_of(run, "loss")
    fits = run.episodes.numbers("episode")[run.episodes.numbers("fitting") > 0]
    before, after = means[:1], means[1:][-1:]
    if len(fits):
        before, after = means[places < fits[0]][-1:], means[places > fits[0] + run.window]
    return float(np.median(after) / before[0]) if len(before) and len(after) else MISSING


def longest_run(run: RunFolder) -> float:
    """Most actions without a bump in the run's own episodes."""
    return float(np.max(run.runs_without_bump)) if len(run.episodes) else MISSING


def _longest_run_episode(run: RunFolder) -> float:
    """Episode in which the longest way without a bump got its full length."""
    lengths = run.runs_without_bump
    return float(run.episodes.numbers("episode")[np.argmax(lengths)]) if len(lengths) else MISSING


MEASURED = {
    "episodes": Measure("episodes", lambda run: float(len(run.episodes)), grows=True),
    "actions": Measure("actions", lambda run: float(run.actions), grows=True),
    "actions_per_episode": Measure(
        "actions per episode",
        lambda run: run.actions / len(run.episodes) if len(run.episodes) else MISSING,
    ),
    "capacity": Measure(
        "largest capacity of the memory", lambda run: highest(run, "capacity"), grows=True
    ),
    "longest_run": Measure("most actions without a bump", longest_run, grows=True),
    "longest_run_episode": Measure(
        "episode of the longest way without a bump", _longest_run_episode, grows=True
    ),
    "fitness": Measure("highest mean fitness", max_mean_fitness),
    "max_threshold_percent": Measure(
        "highest threshold (%)", lambda run: highest(run, "threshold_percent")
    ),
}
"""What stands in `thesis` of run.json under these names is shown beside ours (E37)."""


def of_seeds(experiment: Experiment, measure: Of) -> Floats:
    """One number per seed, float64 [seeds], without those that have none."""
    values = np.array([measure(run) for run in experiment.runs], np.float64)
    return values[np.isfinite(values)]


def evaluated(column: str, world: str, driver: str = "network") -> Of:
    """A figure of the newest drive; `laps` counts both directions."""

    def measure(run: RunFolder) -> float:
        rows = Rows(run.evaluations.where(driver=driver, world=world).rows[-1:])
        values = LAPS.of(rows) if column == "laps" else rows.numbers(column)
        return float(values[0]) if len(values) else MISSING

    return measure


class Kept(NamedTuple):
    """Mean way between two bumps in a world before and after learning another one, in actions."""

    seed: int
    before: float
    after: float

    @property
    def share(self) -> float:
        """What is left of it."""
        return self.after / self.before if self.before else MISSING


def kept(run: RunFolder, world: str, start: RunFolder | None) -> Kept | None:
    """How much of one world is left after the first stages in others; None: it did not drive there.

    start: The run it goes on from, looked at if `run` did not drive before those stages.
    """
    here = dropwhile(lambda stage: stage.world == world, run.info.stages)
    away = list(takewhile(lambda stage: stage.world != world, here))
    if not away or away[-1].last_episode is None:
        return None
    rows = run.evaluated(world)
    episodes, ways = rows.numbers("episode"), ways_between_bumps(rows)
    before = ways[episodes < away[0].first_episode]
    if not len(before) and start is not None:
        before = ways_between_bumps(start.evaluated(world))
    after = ways[(episodes >= away[0].first_episode) & (episodes <= away[-1].last_episode)]
    if not len(before) or not len(after):
        return None
    return Kept(run.info.seed, float(before[-1]), float(after[-1]))


def ways_between_bumps(drives: Rows) -> Floats:
    """Actions for each bump of frozen drives, at most 500 as in the fitness (A37)."""
    return np.minimum(FULL_RUN, drives.numbers("actions") / np.maximum(drives.numbers("bumps"), 1))


def number(value: float) -> str:
    """Three digits that count, thousands apart; a dash for none."""
    if not math.isfinite(value):
        return "-"
    whole = abs(value) >= 100 or value == round(value)
    return (f"{value:,.0f}" if whole else f"{value:.3g}").replace("-", "−")


def spread(values: Floats) -> str:
    """Median, and lowest to highest of several seeds."""
    if not len(values):
        return "-"
    middle = number(float(np.median(values)))
    if len(values) == 1:
        return middle
    return f"{middle} ({number(float(values.min()))} to {number(float(values.max()))})"
