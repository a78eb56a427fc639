"""Tables of a report: every seed beside the floor and the ceiling."""

from __future__ import annotations

from experiments.document import Table
from experiments.measures import evaluated, number
from experiments.runs import Experiment, Run

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
    return Table(title, ("", *lap, *FIGURES.values()), tuple(rows))


def _first_lap(run: Run, timed: bool) -> tuple[str, ...]:
    if not timed:
        return ()
    lap = run.info.first_lap
    return (number(lap["seconds"]), f"{lap['actions']:,.0f}") if lap else ("not yet", "not yet")


def _figures(run: Run, world: str, driver: str) -> tuple[str, ...]:
    return tuple(number(evaluated(column, world, driver)(run)) for column in FIGURES)
