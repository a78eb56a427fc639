"""Tables of everything that was run: how it drives, what it cost, how to repeat it."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources.abc import Traversable

from experiments.plans.plan import PLANS
from experiments.report import costs, tables
from experiments.report.document import Section, Table
from experiments.report.measures import evaluated, number, of_seeds, spread
from experiments.report.run_folder import Experiment, RunFolder

MS_PER_H = 3.6e6
DRIVEN = {
    "bumps_per_1000": "bumps per 1,000 actions",
    "laps": "laps per 1,000 actions",
    "distance": "distance",
    "circling": "circling",
}
"""Figures of the newest frozen drive, and what the table calls them."""


def overview(
    experiments: Sequence[Experiment],
    gpu_step_ms: float | None = None,
    plans: Traversable = PLANS,
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
    header = ["experiment", "seeds", "episodes", "of one action, %", "actions", "gradient steps",
              "hours"]  # fmt: skip
    if gpu_step_ms is not None:
        header.append(f"projected hours of gradient steps on a GPU, {gpu_step_ms:g} ms each")
    header += ["command of the first seed", "machine", "commit"]
    rows = [_origin(experiment, gpu_step_ms) for experiment in experiments]
    title = "What was run, and what all seeds together cost"
    return Table("costs", title, tuple(header), tuple(rows))


def _origin(experiment: Experiment, gpu_step_ms: float | None) -> tuple[str, ...]:
    runs = experiment.runs
    steps = sum(run.train_steps for run in runs)
    projected = () if gpu_step_ms is None else (number(steps * gpu_step_ms / MS_PER_H),)
    return (
        experiment.full_name,
        ", ".join(_seed(run) for run in runs),
        f"{sum(len(run.episodes) for run in runs):,}",
        spread(of_seeds(experiment, lambda run: 100.0 * run.one_action_share)),
        f"{sum(run.actions for run in runs):,}",
        f"{steps:,}",
        f"{sum(run.info.seconds for run in runs) / 3600:.2f}",
        *projected,
        f"`{experiment.first.command}`",
        ", ".join(dict.fromkeys(run.info.machine for run in runs)),
        ", ".join(dict.fromkeys(f"`{run.info.commit}`" for run in runs)),
    )


def _seed(run: RunFolder) -> str:
    return f"{run.info.seed}" if run.info.complete else f"{run.info.seed} (not complete)"
