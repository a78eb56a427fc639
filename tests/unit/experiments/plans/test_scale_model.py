"""What a smaller scale keeps of an experiment (E39)."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from experiments.plans.plan import load_plan
from experiments.plans.scale_model import description, numbers
from services.cli.main import app

EPISODE_ACTIONS = 1299722 / 7000


def test_the_thesis_renews_its_memory_as_often_as_it_says() -> None:
    plan = load_plan("plus-rmm", "full")
    stages = [numbers(plan, index, EPISODE_ACTIONS) for index in range(len(plan.stages))]
    after_the_first = sum(stage["actions of the stage / N"] for stage in stages[1:])
    assert after_the_first == pytest.approx(6000 * EPISODE_ACTIONS / 45000)
    last = stages[-1]
    assert last["actions between equalisations / N"] == pytest.approx(9284 / 45000, rel=1e-3)
    assert last["actions between fits / N"] == pytest.approx(2 * 9284 / 45000, rel=1e-3)
    assert last["gradient steps between equalisations"] == 528
    assert last["what is left of a reward after N actions"] == pytest.approx(0.17, abs=0.01)
    assert last["candidates that are too few / N"] == 1000 / 45000


def test_steps_between_two_equalisations_are_those_that_a_run_makes() -> None:
    plan = load_plan("plus-rmm-nopretrain", "full")
    config = plan.config["learning"]
    found = numbers(plan, 0, EPISODE_ACTIONS)["gradient steps between equalisations"]
    every, fit_every = 50, config["fit_every"]
    batches = 3 * -(-plan.config["memory"]["capacity"] // 128)
    alone = config["mini_batches_per_episode"]
    steps = sum(batches if episode % fit_every == 0 else alone for episode in range(1, 1001))
    assert found == pytest.approx(steps / (1000 / every))


def test_a_scale_that_is_no_model_is_seen_at_once() -> None:
    assert "differs" not in description("plus-rmm", "full")
    lines = description("plus-rmm", "mini").splitlines()
    assert [line for line in lines if "epochs of a fit" in line and "differs" not in line]
    assert [line for line in lines if "between equalisations / N" in line and "differs" in line]


def test_the_command_describes_and_runs_nothing(
    tmp_path: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(str(tmp_path))
    done = CliRunner().invoke(app, ["experiment", "plus-minus", "policy-roulette", "--describe"])
    assert done.exit_code == 0, done.output
    assert "episodes of 236 actions" in done.output
    assert "nothing can be compared" in done.output
