"""Tables of a report: every seed beside the floor and the ceiling, and every test drive."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from experiments.report.document import Table
from experiments.report.measures import (
    MISSING,
    evaluated,
    max_mean_fitness,
    number,
    of_seeds,
    spread,
)
from experiments.report.run_folder import Experiment, RunFolder

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
    name = f"{experiment.full_name}-frozen-{world}"
    return Table(name, title, ("", *lap, *FIGURES.values()), tuple(rows))


def _first_lap(run: RunFolder, timed: bool) -> tuple[str, ...]:
    if not timed:
        return ()
    lap = run.info.first_lap
    return (number(lap["seconds"]), f"{lap['actions']:,.0f}") if lap else ("not yet", "not yet")


def _figures(run: RunFolder, world: str, driver: str) -> tuple[str, ...]:
    return tuple(number(evaluated(column, world, driver)(run)) for column in FIGURES)


def fitness(experiments: Sequence[Experiment], scale: str, figure: str) -> Table:
    """Highest mean fitness beside that of the thesis, and frozen drives beside the fitness.

    Circling is shown because fitness takes it for driving. `figure` is the thesis's.
    """
    window = experiments[0].runs[0].window
    shown = f" ({figure})" if figure else ""
    title = f"Highest mean fitness of {window} episodes{shown}"
    header = (
        "variant", "episodes", "thesis (100 episodes)", "ours", "frozen: bumps per 1,000",
        "frozen: distance", "frozen: circling", "seeds",
    )  # fmt: skip
    rows = tuple(
        (
            experiment.first.title,
            number(len(experiment.runs[0].episodes)),
            number(float(experiment.first.thesis.get("fitness", MISSING))),
            spread(of_seeds(experiment, max_mean_fitness)),
            *(
                spread(of_seeds(experiment, evaluated(name, experiment.first.stages[0].world)))
                for name in ("bumps_per_1000", "distance", "circling")
            ),
            str(len(experiment.runs)),
        )
        for experiment in experiments
    )
    return Table(f"{scale}-fitness", title, header, rows)


def first_laps(experiments: Sequence[Experiment], scale: str) -> Table:
    """How soon each seed of each variant drove a lap frozen, and how well all drove in the end."""
    header = (
        "variant", "plan", "seeds", "drove a lap", "first lap after actions", "after s",
        "bumps per 1,000", "distance", "s in all",
    )  # fmt: skip
    title = f"Variants of {experiments[0].first.title}"
    rows = tuple(_variant(experiment) for experiment in experiments)
    return Table(f"{scale}-first-laps", title, header, rows)


def _variant(experiment: Experiment) -> tuple[str, ...]:
    laps = [run.info.first_lap for run in experiment.runs if run.info.first_lap]
    soonest = (spread(np.array([lap[name] for lap in laps])) for name in ("actions", "seconds"))
    figures = (
        spread(of_seeds(experiment, evaluated(name, experiment.first.stages[0].world)))
        for name in ("bumps_per_1000", "distance")
    )
    return (
        experiment.first.title,
        f"`{experiment.name}`",
        ", ".join(str(run.info.seed) for run in experiment.runs),
        f"{len(laps)} of {len(experiment.runs)}",
        *soonest,
        *figures,
        spread(np.array([run.info.seconds for run in experiment.runs])),
    )


def memories(experiments: Sequence[Experiment], scale: str) -> Table:
    """What memories held in the end, and how many actions were taken for each of their places."""
    header = (
        "experiment", "seeds", "actions for each place", "left of the filling, %",
        "reward below 0, %", "mean reward",
    )  # fmt: skip
    rows = []
    for experiment in experiments:
        told = [
            (run, run.info.memory)
            for run in experiment.runs
            if run.info.memory and len(run.episodes)
        ]
        if not told:
            continue
        turnover = [run.actions / run.episodes.numbers("capacity")[-1] for run, _ in told]
        figures = (
            turnover,
            [100.0 * memory.of_fill for _, memory in told],
            [100.0 * memory.negative for _, memory in told],
            [memory.mean_reward for _, memory in told],
        )
        seeds = ", ".join(str(run.info.seed) for run, _ in told)
        rows.append((experiment.name, seeds, *(spread(np.array(each)) for each in figures)))
    return Table(f"{scale}-memories", "What the memories held in the end", header, tuple(rows))


def test_drives(experiments: Sequence[Experiment]) -> Table:
    """How the test drives of every run went, a row a run (A45)."""
    header = (
        "experiment", "scale", "seed", "full and without a bump", "without a bump", "bumps of each",
    )  # fmt: skip
    rows = tuple(
        (
            run.info.experiment,
            run.info.scale,
            str(run.info.seed),
            f"{sum(tour.passed for tour in run.tours)} of {len(run.tours)}",
            f"{sum(not tour.bumps for tour in run.tours)} of {len(run.tours)}",
            ", ".join(str(tour.bumps) for tour in run.tours),
        )
        for experiment in experiments
        for run in experiment.runs
        if run.tours
    )
    return Table("test-drives", "Test drives (A45)", header, rows)


def tours(experiment: Experiment) -> Table:
    """Every test drive of every seed (A45)."""
    header = (
        "seed", "drive", "full and without a bump", "actions driven", "turns on the spot", "bumps",
        "of the route", "bridges", "past the box",
    )  # fmt: skip
    rows = tuple(
        (
            str(run.info.seed),
            f"tour-{place}",
            _yes(tour.passed),
            f"{tour.driven:,}",
            f"{tour.turned:,}",
            str(tour.bumps),
            f"{100 * tour.route_share:.0f} %",
            ", ".join(tour.bridges) or "-",
            _yes(tour.box_dropped),
        )
        for run in experiment.runs
        for place, tour in enumerate(run.tours)
    )
    title = "Test drives with turns on the spot (A45)"
    return Table(f"{experiment.full_name}-tours", title, header, rows)


def _yes(holds: bool) -> str:
    return "yes" if holds else "no"
