"""Tables of a report: every seed beside the floor and the ceiling, and every test drive."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from experiments.report.document import Table, table
from experiments.report.measures import (
    MISSING,
    evaluated,
    max_mean_fitness,
    number,
    of_seeds,
    spread,
)
from experiments.report.run_folder import Experiment, RunFolder
from shared.run_record import MemoryRecord

FIGURES = {
    "bumps_per_1000": "bumps per 1,000",
    "bumps_per_100m": "bumps per 100 m",
    "mean_run": "mean actions without a bump",
    "laps_left_per_1000": "laps left per 1,000",
    "laps_right_per_1000": "laps right per 1,000",
    "distance": "distance",
    "coverage": "coverage",
    "circling": "circling",
}
"""Columns of `evaluations.csv` and what the table calls them."""
REFERENCES = {"random": "random actions", "planner": "planner that knows the map"}
Told = Callable[[Experiment], str]


def frozen(experiment: Experiment, world: str) -> Table:
    """The newest drives of the frozen network by seed; the last rows: random actions, planner."""
    timed = any(run.info.first_lap for run in experiment.runs)
    lap = ("first lap after s", "after actions") if timed else ()
    rows = [
        (f"seed {run.info.seed}", *_first_lap(run, timed), *_figures(run, world, "network"))
        for run in experiment.runs
    ]
    for driver, shown in REFERENCES.items():
        drove = [run for run in experiment.runs if len(run.evaluations.where(driver=driver).rows)]
        if drove:
            rows.append((shown, *("-" for _ in lap), *_figures(drove[-1], world, driver)))
    title = f"Frozen in {world}, newest drives of every seed"
    name = f"{experiment.full_name}-frozen-{world}"
    return Table(name, title, ("", *lap, *FIGURES.values()), tuple(rows))


def _first_lap(run: RunFolder, timed: bool) -> tuple[str, ...]:
    if not timed:
        return ()
    lap = run.info.first_lap
    return (number(lap["seconds"]), f"{lap['actions']:,.0f}") if lap else ("not yet", "not yet")


def _figures(run: RunFolder, world: str, driver: str) -> tuple[str, ...]:
    return tuple(number(evaluated(column, world, driver)(run)) for column in FIGURES)


def _in_first_world(column: str) -> Told:
    """A figure of the newest frozen drives in the world of the first stage."""
    return lambda e: spread(of_seeds(e, evaluated(column, e.first.stages[0].world)))


def fitness(experiments: Sequence[Experiment], scale: str, figure: str) -> Table:
    """Highest mean fitness beside that of the thesis, and frozen drives beside the fitness.

    Circling is shown because fitness takes it for driving. `figure` is the thesis's.
    """
    shown = f" ({figure})" if figure else ""
    title = f"Highest mean fitness of {experiments[0].runs[0].window} episodes{shown}"
    return table(f"{scale}-fitness", title, experiments, {
        "variant": lambda e: e.first.title,
        "episodes": lambda e: number(len(e.runs[0].episodes)),
        "thesis (100 episodes)": lambda e: number(float(e.first.thesis.get("fitness", MISSING))),
        "ours": lambda e: spread(of_seeds(e, max_mean_fitness)),
        "frozen: bumps per 1,000": _in_first_world("bumps_per_1000"),
        "frozen: distance": _in_first_world("distance"),
        "frozen: circling": _in_first_world("circling"),
        "seeds": lambda e: str(len(e.runs)),
    })  # fmt: skip


def memories(experiments: Sequence[Experiment], scale: str) -> Table:
    """What memories held in the end, and how many actions were taken for each of their places."""

    def told(e: Experiment) -> list[tuple[RunFolder, MemoryRecord]]:
        runs = [run for run in e.runs if len(run.episodes)]
        return [(run, run.info.memory) for run in runs if run.info.memory]

    def of(figure: Callable[[RunFolder, MemoryRecord], float]) -> Told:
        return lambda e: spread(np.array([figure(*each) for each in told(e)]))

    shown = [experiment for experiment in experiments if told(experiment)]
    return table(f"{scale}-memories", "What the memories held in the end", shown, {
        "experiment": lambda e: e.name,
        "seeds": lambda e: ", ".join(str(run.info.seed) for run, _ in told(e)),
        "actions for each place": of(lambda run, _: run.actions
                                     / run.episodes.numbers("capacity")[-1]),
        "left of the filling, %": of(lambda _, memory: 100.0 * memory.of_fill),
        "reward below 0, %": of(lambda _, memory: 100.0 * memory.negative),
        "mean reward": of(lambda _, memory: memory.mean_reward),
    })  # fmt: skip


def test_drives(experiments: Sequence[Experiment]) -> Table:
    """How the test drives of every run went, a row a run (A45)."""
    runs = [run for experiment in experiments for run in experiment.runs if run.tours]
    return table("test-drives", "Test drives (A45)", runs, {
        "experiment": lambda run: run.info.experiment,
        "scale": lambda run: run.info.scale,
        "seed": lambda run: str(run.info.seed),
        "full and without a bump":
            lambda run: f"{sum(tour.passed for tour in run.tours)} of {len(run.tours)}",
        "without a bump":
            lambda run: f"{sum(not tour.bumps for tour in run.tours)} of {len(run.tours)}",
        "bumps of each": lambda run: ", ".join(str(tour.bumps) for tour in run.tours),
    })  # fmt: skip


def tours(experiment: Experiment) -> Table:
    """Every test drive of every seed (A45)."""
    drives = [(run, *each) for run in experiment.runs for each in enumerate(run.tours)]
    title = "Test drives with turns on the spot (A45)"
    return table(f"{experiment.full_name}-tours", title, drives, {
        "seed": lambda drive: str(drive[0].info.seed),
        "drive": lambda drive: f"tour-{drive[1]}",
        "full and without a bump": lambda drive: _yes(drive[2].passed),
        "actions driven": lambda drive: f"{drive[2].driven:,}",
        "turns on the spot": lambda drive: f"{drive[2].turned:,}",
        "bumps": lambda drive: str(drive[2].bumps),
        "of the route": lambda drive: f"{100 * drive[2].route_share:.0f} %",
        "bridges": lambda drive: ", ".join(drive[2].bridges) or "-",
        "past the box": lambda drive: _yes(drive[2].box_dropped),
    })  # fmt: skip


def _yes(holds: bool) -> str:
    return "yes" if holds else "no"
