"""Single numbers of runs, how they are written, and comparisons of seeds."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import dropwhile, takewhile

import numpy as np

from experiments.drives.traces import FULL_RUN
from experiments.report.figures.drives import Compared, laps
from experiments.report.figures.progress import curve_of
from experiments.report.run_folder import Experiment, Floats, Rows, RunFolder
from experiments.report.statistics import bootstrap_difference
from shared.rl.draws import generator
from shared.run_record import RunInfo

MISSING = float("nan")
BOOTSTRAP_SEED = 0


@dataclass(frozen=True)
class Measure:
    """A number of a run that the thesis tells as well."""

    text: str
    of: Callable[[RunFolder], float]
    grows: bool = False
    """Whether it grows with the scale."""

    def scaled(self, value: float, info: RunInfo) -> float:
        """A number of the thesis at the scale of a run."""
        return value / info.factor if self.grows else value


def _highest(run: RunFolder, column: str) -> float:
    values = run.episodes.numbers(column)
    return float(np.nanmax(values)) if np.any(~np.isnan(values)) else MISSING


def max_mean_fitness(run: RunFolder) -> float:
    """Highest point of the fitness curve (A38)."""
    return float(np.max(curve_of(run, "fitness")[1], initial=-math.inf))


def longest_run_episode(run: RunFolder) -> float:
    """Episode in which the longest way without a bump got its full length."""
    lengths = run.runs_without_bump
    return float(run.episodes.numbers("episode")[np.argmax(lengths)]) if len(lengths) else MISSING


def longest_run(run: RunFolder) -> float:
    """Most actions without a bump in the run's own episodes."""
    return float(np.max(run.runs_without_bump)) if len(run.episodes) else MISSING


def actions_per_episode(run: RunFolder) -> float:
    """Mean of all episodes."""
    return run.actions / len(run.episodes) if len(run.episodes) else MISSING


MEASURED = {
    "episodes": Measure("episodes", lambda run: float(len(run.episodes)), grows=True),
    "actions": Measure("actions", lambda run: float(run.actions), grows=True),
    "actions_per_episode": Measure("actions per episode", actions_per_episode),
    "capacity": Measure(
        "largest capacity of the memory", lambda run: _highest(run, "capacity"), grows=True
    ),
    "longest_run": Measure("most actions without a bump", longest_run, grows=True),
    "longest_run_episode": Measure(
        "episode of the longest way without a bump", longest_run_episode, grows=True
    ),
    "fitness": Measure("highest mean fitness", max_mean_fitness),
    "max_threshold_percent": Measure(
        "highest threshold (%)", lambda run: _highest(run, "threshold_percent")
    ),
}
"""What stands in `thesis` of run.json under these names is shown beside ours (E37)."""


def of_seeds(experiment: Experiment, measure: Callable[[RunFolder], float]) -> Floats:
    """One number per seed, float64 [seeds], without those that have none."""
    values = np.array([measure(run) for run in experiment.runs], np.float64)
    return values[np.isfinite(values)]


def newest(run: RunFolder, world: str, driver: str = "network") -> Rows:
    """The last drive of a driver in a world, one row or none."""
    return Rows(run.evaluations.where(driver=driver, world=world).rows[-1:])


def evaluated(column: str, world: str, driver: str = "network") -> Callable[[RunFolder], float]:
    """A figure of the newest drive; `laps` counts both directions."""

    def measure(run: RunFolder) -> float:
        rows = newest(run, world, driver)
        values = laps(rows) if column == "laps" else rows.numbers(column)
        return float(values[0]) if len(values) else MISSING

    return measure


def compare(
    experiments: Sequence[Experiment], *, first_only: bool = False
) -> tuple[list[Compared], list[str]]:
    """Differences of bumps between pairs that drove in the same world.

    Args:
        experiments: At least two.
        first_only: Only pairs with the first of them, in place of all.

    Returns:
        The differences, and a few words for every pair with fewer than 2 seeds of either.
    """
    pairs, refused = [], []
    for i, ours in enumerate(experiments[:1] if first_only else experiments):
        for theirs in experiments[i + 1 :]:
            for world in sorted({*ours.worlds} & {*theirs.worlds}):
                bumps = evaluated("bumps_per_1000", world)
                a, b = of_seeds(ours, bumps), of_seeds(theirs, bumps)
                draw = generator(BOOTSTRAP_SEED, "bootstrap", ours.name, theirs.name, world)
                if min(len(a), len(b)) < 2:
                    names = f"{ours.name} and {theirs.name} in {world}"
                    refused.append(f"{names}: {len(a)} and {len(b)} seeds")
                    continue
                difference = bootstrap_difference(a, b, draw)
                pairs.append(Compared(ours.name, theirs.name, world, (len(a), len(b)), difference))
    return pairs, refused


@dataclass(frozen=True)
class Equal:
    """Bumps per 1,000 actions of two networks of one seed after equally many actions of learning.

    Each is the newest frozen drive up to there, which may be some actions older.
    """

    seed: int
    actions: int
    ours: float
    theirs: float


def at_equal_actions(
    ours: Experiment, theirs: Experiment, named: Mapping[str, Experiment], world: str
) -> list[Equal]:
    """Seeds of both, each after as many actions as the one that drove less.

    Args:
        ours: One experiment.
        theirs: The other.
        named: Experiments by name, among them those that the two go on from: their drives and
            actions come before.
        world: Where they drove frozen.
    """
    found = []
    rivals = {run.info.seed: run for run in theirs.runs}
    for run in ours.runs:
        if (rival := rivals.get(run.info.seed)) is None:
            continue
        curves = [_with_before(each, named, world) for each in (run, rival)]
        if not all(len(actions) for actions, _ in curves):
            continue
        end = min(actions[-1] for actions, _ in curves)
        if any(actions[0] > end for actions, _ in curves):
            continue
        a, b = (bumps[np.searchsorted(actions, end, "right") - 1] for actions, bumps in curves)
        found.append(Equal(run.info.seed, int(end), float(a), float(b)))
    return found


def _with_before(
    run: RunFolder, named: Mapping[str, Experiment], world: str
) -> tuple[Floats, Floats]:
    """Actions driven while learning, and bumps of frozen drives, predecessors' first."""
    rows = run.evaluated(world)
    actions, bumps = rows.numbers("total_actions"), rows.numbers("bumps_per_1000")
    for before in named[run.info.after].runs if run.info.after in named else ():
        if before.info.seed == run.info.seed:
            earlier = _with_before(before, named, world)
            actions, bumps = np.append(earlier[0], actions), np.append(earlier[1], bumps)
    return actions, bumps


def difference_at_equal_actions(
    ours: str, theirs: str, world: str, found: Sequence[Equal]
) -> Compared | None:
    """The difference over all seeds; None with fewer than two."""
    if len(found) < 2:
        return None
    draw = generator(BOOTSTRAP_SEED, "equal-actions", ours, theirs, world)
    groups = np.array([(each.ours, each.theirs) for each in found]).T
    difference = bootstrap_difference(groups[0], groups[1], draw)
    return Compared(ours, theirs, world, (len(found), len(found)), difference)


@dataclass(frozen=True)
class Kept:
    """Mean way between two bumps in a world before and after learning another one, in actions."""

    seed: int
    before: float
    after: float

    @property
    def share(self) -> float:
        """What is left of it."""
        return self.after / self.before if self.before else MISSING


def kept(run: RunFolder, world: str, start: RunFolder | None) -> Kept | None:
    """How much of one world is left after the first stages in others.

    Args:
        run: It learned elsewhere for one stage or more.
        world: The one it could drive in before.
        start: The run it goes on from, looked at if `run` did not drive before those stages.

    Returns:
        None where one of the two drives is missing.
    """
    stages = run.info.stages
    away = list(
        takewhile(lambda s: s.world != world, dropwhile(lambda s: s.world == world, stages))
    )
    if not away or away[-1].last_episode is None:
        return None
    first, last = away[0].first_episode, away[-1].last_episode
    rows = run.evaluated(world)
    episodes, ways = rows.numbers("episode"), ways_between_bumps(rows)
    before = ways[episodes < first]
    if not len(before) and start is not None:
        before = ways_between_bumps(newest(start, world))
    after = ways[(episodes >= first) & (episodes <= last)]
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
    if abs(value) >= 100 or value == round(value):
        return f"{value:,.0f}".replace("-", "−")
    return f"{value:.3g}".replace("-", "−")


def spread(values: Floats) -> str:
    """Median, and lowest to highest of several seeds."""
    if not len(values):
        return "-"
    middle = number(float(np.median(values)))
    if len(values) == 1:
        return middle
    return f"{middle} ({number(float(values.min()))} to {number(float(values.max()))})"
