"""What plans cost at full scale: gradient steps by arithmetic, hours from the runs there are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources.abc import Traversable

import numpy as np

from experiments.plans.plan import PLANS, Plan, plan_names, stage_config
from experiments.plans.scales import episode_actions, load_plan
from experiments.report.document import Block, Missing, Table
from experiments.report.run_folder import Experiment, RunFolder

TITLE = "Cost of the full scale, a seed each"


@dataclass(frozen=True)
class Rates:
    """What one action and one gradient step take while learning, frozen drives not counted."""

    action_s: float
    step_s: float

    def hours(self, actions: float, steps: float) -> float:
        """Hours that these numbers of actions and of gradient steps take."""
        return (actions * self.action_s + steps * self.step_s) / 3600.0


def gradient_steps(plan: Plan) -> int:
    """Gradient steps of a plan whose memory is as full as its configuration allows.

    A memory that may grow (A44) counts with the capacity it begins with. Fitting phases are due at
    multiples of their period, and take the place of that episode's mini-batches (A36).
    """
    total = start = 0
    for index, stage in enumerate(plan.stages):
        config = stage_config(plan, index, seed=1)
        learning = config.learning
        counts_actions = plan.counted_in == "actions"
        every = learning.fit_every_actions if counts_actions else learning.fit_every
        fits = stage.until // every - start // every if every else 0
        fits += learning.fit_after_fill and start == 0 and every != 1
        batches = learning.fit_epochs * -(-config.memory.capacity // learning.batch_size)
        total += fits * batches
        episodes = stage.until - start
        if counts_actions and learning.mini_batches_per_episode:
            episodes = round(episodes / episode_actions(plan))
        total += (episodes - fits) * learning.mini_batches_per_episode
        start = stage.until
    return total


def rates(runs: Sequence[RunFolder]) -> Rates | None:
    """Seconds of an action and of a gradient step that tell the runs' seconds best.

    Least squares of the relative errors. None where the runs cannot tell the two apart.
    """
    trained = [run for run in runs if run.info.complete and len(run.episodes)]
    done = [run for run in trained if run.info.seconds > 0.0]
    counts = np.array([(run.actions, run.train_steps) for run in done], np.float64).reshape(-1, 2)
    seconds = np.array([run.info.seconds for run in done], np.float64)
    found, _, rank, _ = np.linalg.lstsq(counts / seconds[:, None], np.ones(len(done)), rcond=None)
    if rank < 2 or found.min() < 0.0:
        return None
    return Rates(float(found[0]), float(found[1]))


def full_scale(
    experiments: Sequence[Experiment], gpu_step_ms: float | None = None, plans: Traversable = PLANS
) -> Block:
    """The cost of every plan at full scale: measured where it was run, else projected.

    Args:
        experiments: At any scale. Actions are those of full runs, else those that the thesis
            gives, else as many as the plan's mean episode makes.
        gpu_step_ms: Measured time of a gradient step on a GPU; adds a column of projected hours.
        plans: The folder of plans.
    """
    named = {(e.scale, e.name): e for e in experiments}
    found = rates([run for e in experiments if e.scale == "full" for run in e.runs])
    if found is None:
        why = "too few runs at full scale to tell actions and gradient steps apart"
        return Missing(TITLE.lower(), why)
    header = ["plan", "actions", "from", "gradient steps", "hours measured", "hours projected"]
    projections = [found]
    if gpu_step_ms is not None:
        header.append(f"projected with a GPU, {gpu_step_ms:g} ms a step")
        projections.append(Rates(found.action_s, gpu_step_ms / 1000.0))
    every = [load_plan(name, "full", plans) for name in plan_names(plans)]
    rows = tuple(
        _row(plan, named.get(("full", plan.name)), projections)
        for plan in every
        if plan.stages and plan.report.full_scale
    )
    each = f"{1000 * found.action_s:.1f} ms an action, {found.step_s:.2f} s a gradient step"
    return Table("full-scale", f"{TITLE}: {each}", tuple(header), rows)


def _row(plan: Plan, full: Experiment | None, projections: Sequence[Rates]) -> tuple[str, ...]:
    actions, source = _actions(plan, full)
    steps = gradient_steps(plan)
    done = [run.info.seconds for run in full.runs if run.info.complete] if full else []
    hours = (f"{rates.hours(actions, steps):.1f}" if source else "-" for rates in projections)
    return (
        plan.name,
        f"{actions:,.0f}" if source else "-",
        source or "not known",
        f"{steps:,}",
        f"{np.mean(done) / 3600.0:.2f}" if done else "-",
        *hours,
    )


def _actions(plan: Plan, full: Experiment | None) -> tuple[float, str]:
    """How many to reckon with, and where the number comes from; empty: from nowhere."""
    complete = [run for run in full.runs if run.info.complete] if full else []
    if complete:
        return float(np.median([run.actions for run in complete])), "our runs, full"
    if told := plan.thesis.get("actions"):
        return told, "thesis"
    if plan.counted_in == "actions":
        return plan.stages[-1].until, "the plan"
    if length := episode_actions(plan):
        return length * plan.stages[-1].until, f"episodes of {length:.0f} actions"
    return 0.0, ""
