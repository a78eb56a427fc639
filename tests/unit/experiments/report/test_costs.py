"""What full scale costs: counted by hand, held to the runs that are kept, and told honestly."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from experiments.plans.plan import Plan, stage_config
from experiments.plans.scales import load_plan
from experiments.report import archives, costs
from experiments.report.document import Missing, Table
from experiments.report.run_folder import Experiment, load
from experiments.results import DOCS
from tests.synthetic_runs import write_run

ACTION_S, STEP_S = 0.002, 0.5


def counted_one_by_one(plan: Plan) -> int:
    """Gradient steps, episode by episode."""
    steps, episode = 0, 1
    for index, stage in enumerate(plan.stages):
        config = stage_config(plan, index, seed=1)
        while episode <= stage.until:
            due = config.learning.fit_every and episode % config.learning.fit_every == 0
            if due or (config.learning.fit_after_fill and episode == 1):
                batches = math.ceil(config.memory.capacity / config.learning.batch_size)
                steps += config.learning.fit_epochs * batches
            else:
                steps += config.learning.mini_batches_per_episode
            episode += 1
    return steps


@pytest.mark.parametrize("name", ["demo", "plus-rmm", "plus-normm-fit", "i16c", "real-corridor"])
def test_gradient_steps_are_those_of_the_schedule(name: str) -> None:
    plan = load_plan(name, "full")
    assert costs.gradient_steps(plan) == counted_one_by_one(plan)


def test_gradient_steps_agree_with_the_runs_that_are_kept() -> None:
    for experiment in archives.load(sorted((DOCS / "results").glob("*.tar.xz"))):
        if not experiment.first.stages or experiment.scale != "full":
            continue
        told = costs.gradient_steps(load_plan(experiment.name, experiment.scale))
        for run in experiment.runs:
            if run.info.complete:
                # RMM may leave the memory less full than it could be
                assert 0.75 * told <= run.train_steps <= told, run.folder


def full_runs(out: Path) -> list[Experiment]:
    """Two runs whose seconds are exactly so much an action and so much a step."""
    for name, seed in (("plus-rmm", 1), ("plus-normm", 1)):
        write_run(out, name, seed, scale="full")
        (run,) = load([out / f"{name}-tenth" / f"seed-{seed}"])[0].runs
        seconds = run.actions * ACTION_S + run.train_steps * STEP_S
        info = run.folder / "run.json"
        info.write_text(json.dumps(json.loads(info.read_text()) | {"seconds": seconds}))
    return load([out])


def test_rates_are_found_from_seconds(tmp_path: Path) -> None:
    every = [run for experiment in full_runs(tmp_path) for run in experiment.runs]
    found = costs.rates(every)
    assert found is not None
    assert (found.action_s, found.step_s) == pytest.approx((ACTION_S, STEP_S))
    assert found.hours(3_600_000, 7200) == pytest.approx(3.0)
    assert costs.rates(every[:1]) is None
    assert costs.rates([]) is None


def test_every_plan_has_a_row_with_where_its_actions_come_from(tmp_path: Path) -> None:
    experiments = full_runs(tmp_path)
    table = costs.full_scale(experiments, gpu_step_ms=5.0)
    assert isinstance(table, Table)
    assert "2.0 ms an action, 0.50 s a gradient step" in table.title
    rows = {row[0]: dict(zip(table.header, row, strict=True)) for row in table.rows}
    assert rows["plus-rmm"]["from"] == "our runs, full"
    assert rows["plus-rmm"]["hours measured"] != "-"
    assert (rows["i16c"]["actions"], rows["i16c"]["from"]) == ("273,965", "thesis")
    steps = costs.gradient_steps(load_plan("i16c", "full"))
    assert rows["i16c"]["gradient steps"] == f"{steps:,}"
    hours = (273_965 * ACTION_S + steps * STEP_S) / 3600
    assert rows["i16c"]["hours projected"] == f"{hours:.1f}"
    hours = (273_965 * ACTION_S + steps * 0.005) / 3600
    assert rows["i16c"]["projected with a GPU, 5 ms a step"] == f"{hours:.1f}"
    assert rows["plus-rmm-quotas"]["from"] == "episodes of 186 actions"
    assert rows["policy-roulette"]["hours projected"] == "-"
    assert "search-demo" not in rows


def test_without_full_runs_nothing_is_projected(tmp_path: Path) -> None:
    write_run(tmp_path, "plus-rmm", 1)
    assert isinstance(costs.full_scale(load([tmp_path])), Missing)
