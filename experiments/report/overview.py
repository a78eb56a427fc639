"""Tables of everything that was run: how it drives, what it cost, how to repeat it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from experiments.report import tables
from experiments.report.document import Section, Table, table
from experiments.report.measures import evaluated, of_seeds, spread
from experiments.report.run_folder import Experiment

DRIVEN = {
    "bumps_per_1000": "bumps per 1,000 actions",
    "laps": "laps per 1,000 actions",
    "distance": "distance",
    "circling": "circling",
}
"""Figures of the newest frozen drive, and what the table calls them."""


def overview(experiments: Sequence[Experiment]) -> Section:
    """Everything that was run, and what it cost."""
    drives = tables.test_drives(experiments)
    blocks = (_driven(experiments), _origins(experiments))
    return Section("runs", "All runs", (*blocks, drives) if drives.rows else blocks)


def _driven(experiments: Sequence[Experiment]) -> Table:
    """A row per experiment and corridor in which its frozen networks drove."""
    rows: list[tuple[str, ...]] = []
    for experiment in experiments:
        for world in experiment.worlds:
            values = [of_seeds(experiment, evaluated(column, world)) for column in DRIVEN]
            seeds = str(max(len(each) for each in values))
            rows.append((experiment.full_name, world, seeds, *map(spread, values)))
    title = "Newest drives of the frozen networks: median of the seeds, lowest to highest"
    return Table("drives", title, ("experiment", "frozen in", "seeds", *DRIVEN.values()),
                 tuple(rows))  # fmt: skip


def _origins(experiments: Sequence[Experiment]) -> Table:
    """What every experiment cost, and how to repeat it."""
    columns: dict[str, Callable[[Experiment], str]] = {
        "experiment": lambda e: e.full_name,
        "seeds": lambda e: ", ".join(
            f"{run.info.seed}{'' if run.info.complete else ' (not complete)'}" for run in e.runs
        ),
        "episodes": lambda e: f"{sum(len(run.episodes) for run in e.runs):,}",
        "of one action, %": lambda e: spread(of_seeds(e, lambda r: 100.0 * r.one_action_share)),
        "actions": lambda e: f"{sum(run.actions for run in e.runs):,}",
        "gradient steps": lambda e: f"{sum(run.train_steps for run in e.runs):,}",
        "hours": lambda e: f"{sum(run.info.seconds for run in e.runs) / 3600:.2f}",
        "command of the first seed": lambda e: f"`{e.first.command}`",
        "machine": lambda e: ", ".join(dict.fromkeys(run.info.machine for run in e.runs)),
        "commit": lambda e: ", ".join(dict.fromkeys(f"`{run.info.commit}`" for run in e.runs)),
    }
    return table("costs", "What was run, and what all seeds together cost", experiments, columns)
