"""What `corridor experiment` does: checks its options and runs plans."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from experiments.plans.plan import full_plan, plan_names
from experiments.plans.scale_model import description
from experiments.plans.scales import load_plan
from experiments.runs.schedule import OUT, run_experiment
from shared.errors import ConfigError


def listing() -> str:
    """All plans with what they are, one a line."""
    plans = [full_plan(name) for name in plan_names()]
    width = max(len(plan.name) for plan in plans)
    return "\n".join(
        f"{plan.name:{width}}  {plan.title} ({plan.source})"
        + (f"; after {plan.after}" if plan.after else "")
        for plan in plans
    )


def described(names: Sequence[str], scale: str) -> str:
    """How much of the plans a scale keeps. Raises ConfigError."""
    return "\n\n".join(description(name, scale) for name in names)


def run(
    names: Sequence[str], scale: str, seeds: int, seed: int | None, jobs: int, out: Path | None
) -> int:
    """Run them; returns 0, or 1 when stopped before the end. Raises ConfigError, CorridorError."""
    wanted = seeds if seed is None else [seed]
    for name in names:
        available = load_plan(name, scale).seeds
        if isinstance(wanted, int) and wanted > len(available):
            raise ConfigError(f"--seeds: {name} has {len(available)} seeds, got {wanted}")
    folder = out or OUT
    done = run_experiment(names, scale, wanted, folder, jobs, Console())
    return 0 if done else 1
