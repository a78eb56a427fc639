"""Tables of everything that was run: how it drives, what it cost, how to repeat it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.resources.abc import Traversable

from experiments.plans.plan import PLANS
from experiments.report import costs, tables
from experiments.report.document import Section, Table, table
from experiments.report.measures import evaluated, number, of_seeds, spread
from experiments.report.run_folder import Experiment

MS_PER_H = 3.6e6
DRIVEN = {
    "bumps_per_1000": "bumps per 1,000 actions",
    "laps": "laps per 1,000 actions",
    "distance": "distance",
    "circling": "circling",
}
"""Figures of the newest frozen drive, and what the table calls them."""


def overview(
    experiments: Sequence[Experiment], gpu_step_ms: float | None = None, plans: Traversable = PLANS
) -> Section:
    """Everything that was run, and what it cost.

    Args:
        experiments: All of them.
        gpu_step_ms: Measured time of a gradient step on a GPU; adds projected hours.
        plans: The folder of plans.
    """
    full = costs.full_scale(experiments, gpu_step_ms, plans)
    drives = tables.test_drives(experiments)
    blocks = (_driven(experiments), _origins(experiments, gpu_step_ms), full)
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


def _origins(experiments: Sequence[Experiment], gpu_step_ms: float | None) -> Table:
    """What every experiment cost, and how to repeat it."""

    def steps(e: Experiment) -> int:
        return sum(run.train_steps for run in e.runs)

    columns: dict[str, Callable[[Experiment], str]] = {
        "experiment": lambda e: e.full_name,
        "seeds": lambda e: ", ".join(
            f"{run.info.seed}{'' if run.info.complete else ' (not complete)'}" for run in e.runs
        ),
        "episodes": lambda e: f"{sum(len(run.episodes) for run in e.runs):,}",
        "of one action, %": lambda e: spread(of_seeds(e, lambda r: 100.0 * r.one_action_share)),
        "actions": lambda e: f"{sum(run.actions for run in e.runs):,}",
        "gradient steps": lambda e: f"{steps(e):,}",
        "hours": lambda e: f"{sum(run.info.seconds for run in e.runs) / 3600:.2f}",
    }
    if gpu_step_ms is not None:
        title = f"projected hours of gradient steps on a GPU, {gpu_step_ms:g} ms each"
        columns[title] = lambda e: number(steps(e) * gpu_step_ms / MS_PER_H)
    columns |= {
        "command of the first seed": lambda e: f"`{e.first.command}`",
        "machine": lambda e: ", ".join(dict.fromkeys(run.info.machine for run in e.runs)),
        "commit": lambda e: ", ".join(dict.fromkeys(f"`{run.info.commit}`" for run in e.runs)),
    }
    return table("costs", "What was run, and what all seeds together cost", experiments, columns)
