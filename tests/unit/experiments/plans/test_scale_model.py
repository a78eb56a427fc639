"""What a smaller scale keeps of an experiment (E39)."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from experiments.plans.plan import full_plan, plan_names
from experiments.plans.scale_model import (
    EPISODE,
    SMALL_MEMORY,
    STEPS,
    description,
    differing,
    numbers,
)
from services.cli.main import app

EPISODE_ACTIONS = 1299722 / 7000
SMALL_MEMORIES = {("plus-rmm", "small-memory"), ("plus-rmm-roulette", "small-memory")}
"""Stages whose memory cannot be divided by ten."""


def test_the_thesis_renews_its_memory_as_often_as_it_says() -> None:
    plan = full_plan("plus-rmm")
    stages = [numbers(plan, index, EPISODE_ACTIONS) for index in range(len(plan.stages))]
    after_the_first = sum(stage["actions of the stage / N"] for stage in stages[1:])
    assert after_the_first == pytest.approx(6000 * EPISODE_ACTIONS / 45000)
    last = stages[-1]
    assert last["actions between equalisations / N"] == pytest.approx(9284 / 45000, rel=1e-3)
    assert last["actions between fits / N"] == pytest.approx(2 * 9284 / 45000, rel=1e-3)
    assert last[STEPS] == pytest.approx(528)
    assert last["what is left of a reward after N actions"] == pytest.approx(0.17, abs=0.01)
    assert last["candidates that are too few / N"] == 1000 / 45000


@pytest.mark.parametrize("scale", ["tenth", "fifth", "tenth-wide"])
@pytest.mark.parametrize("name", plan_names())
def test_every_plan_is_a_model_of_the_thesis_but_for_what_cannot_be(name: str, scale: str) -> None:
    """R1: all numbers within 10 %."""
    for stage, reasons in differing(full_plan(name), scale).items():
        if (name, stage) in SMALL_MEMORIES:
            assert set(reasons.values()) == {SMALL_MEMORY}
        else:
            assert set(reasons) <= {EPISODE, STEPS}


def test_numbers_that_cannot_be_kept_are_told_with_the_reason() -> None:
    assert "differs" not in description("plus-rmm", "full")
    lines = description("plus-rmm-nopretrain", "tenth").splitlines()
    marked = [line for line in lines if "differs: " in line]
    assert [line.split("  ")[1] for line in marked] == [EPISODE, STEPS]
    assert all(len(line.split("differs: ")[1]) > 20 for line in marked)


def test_the_command_describes_and_runs_nothing(
    tmp_path: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(str(tmp_path))
    done = CliRunner().invoke(app, ["experiment", "plus-minus", "policy-roulette", "--describe"])
    assert done.exit_code == 0, done.output
    assert "episodes of 236 actions" in done.output
    assert "as large at this scale as at full scale" in done.output
