"""Claims of the thesis, judged from made-up runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest

from experiments.plans.plan import plan_names, presentations
from experiments.plans.presentation import Claim, Presentation
from experiments.report import claims
from experiments.report.claims import claims_sections, holds, judged
from experiments.report.document import Table
from experiments.report.run_folder import Experiment, Rows, RunFolder
from tests.synthetic_runs import experiment


@pytest.mark.parametrize(
    ("held", "seeds", "expected"),
    [
        (0, 0, "not run"), (3, 3, "undecided"), (4, 4, "supported"), (0, 4, "contradicted"),
        (8, 12, "undecided"), (10, 12, "supported"), (1, 12, "contradicted"),
    ],
)  # fmt: skip
def test_it_takes_enough_seeds_that_agree(held: int, seeds: int, expected: str) -> None:
    assert judged(held, seeds)[0] == expected


def test_a_figure_may_have_bounds_on_either_side() -> None:
    claim = Claim(text="t", source="s", figure="highest-threshold", least=3, most=5)
    assert [holds(claim, value) for value in (2.9, 3.0, 5.0, 5.1)] == [False, True, True, False]


def test_every_figure_that_plans_may_name_can_be_measured() -> None:
    named = get_args(Claim.model_fields["figure"].annotation)
    assert set(named) == set(claims.TOLD)
    shown = presentations(plan_names())
    claimed = [claim for each in shown.values() for claim in each.claims]
    assert len(claimed) > 10
    for claim in claimed:
        assert set(claim.others) <= set(plan_names())
        assert (claim.least, claim.most) != (None, None)


def drove(run: RunFolder, name: str, *bumps: tuple[str, int]) -> RunFolder:
    """The run of an experiment, with frozen drives in Plus at the ends of stages."""
    rows = tuple(
        {**run.evaluations.rows[0], "driver": "network", "world": "plus",
         "label": f"stage {stage}", "actions": "25600", "bumps": str(count),
         "laps_left_per_1000": "2.0", "laps_right_per_1000": "0.0"}
        for stage, count in bumps
    )  # fmt: skip
    info = run.info.model_copy(update={"experiment": name})
    return replace(run, info=info, evaluations=Rows(rows))


def rows_of(*experiments: Experiment) -> Mapping[str, tuple[str, ...]]:
    """Rows of the table of the only scale, by claim."""
    shown = presentations(each.name for each in experiments)
    (section,) = claims_sections(experiments, shown)
    (table,) = section.blocks
    assert isinstance(table, Table)
    assert table.name == section.name == "claims-tenth"
    return {row[0]: row for row in table.rows}


def test_bumps_are_compared_seed_by_seed(tmp_path: Path) -> None:
    runs = experiment(tmp_path, "plus-rmm", (1, 2, 3, 4, 5)).runs
    bumps = (("plus", 9), ("minus", 99))
    ours = Experiment(tuple(drove(run, "corridors-rmm", *bumps) for run in runs))
    bumps = (("plus", 19), ("minus", 9))
    theirs = Experiment(tuple(drove(run, "corridors-normm", *bumps) for run in runs[:4]))
    rows = rows_of(ours, theirs)
    fewer = rows["RMM bumps less than NoRMM in Plus"]
    assert fewer[2:4] == ("supported", "4 of 4 (51 to 100 %)")
    assert fewer[4].endswith("0.487 (0.487 to 0.487)")
    assert rows["After Minus, RMM bumps less than NoRMM in Plus"][2] == "contradicted"
    both = rows["RMM drives Plus both ways round"]
    assert both[2:4] == ("contradicted", "0 of 5 (0 to 43.4 %)")
    alone = rows_of(ours)
    assert alone["RMM bumps less than NoRMM in Plus"][2] == "not run"


def test_figures_of_runs_with_memories_are_told(tmp_path: Path) -> None:
    names = ("plus-rmm", "plus-minus", "plus-normm-fit", "policy-roulette", "policy-eps-greedy",
             "policy-eps-greedy-roulette")  # fmt: skip
    rows = rows_of(*(experiment(tmp_path, name, (1, 2)) for name in names))
    assert len(rows) == 11
    alone = {"RMM bumps less than NoRMM", "RMM bumps less than NoRMM in Plus after Minus and Plus"}
    for claim, row in rows.items():
        assert ("0 of 0" if claim in alone else " of 2 (") in row[3], row
    assert rows["RMM keeps the actions balanced"][2:4] == ("undecided", "2 of 2 (34.2 to 100 %)")
    assert rows["The loss falls with the first fitting phase"][3].startswith("2 of 2")


def test_other_scales_stand_apart_and_nothing_claimed_is_no_section(tmp_path: Path) -> None:
    (run,) = experiment(tmp_path, "plus-rmm").runs
    full = Experiment((replace(run, info=run.info.model_copy(update={"scale": "full"})),))
    shown = presentations(["plus-rmm"])
    names = [section.name for section in claims_sections([full, Experiment((run,))], shown)]
    assert names == ["claims-full", "claims-tenth"]
    assert claims_sections([full], {"plus-rmm": Presentation()}) == []
