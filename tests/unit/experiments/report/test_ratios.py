"""Drives compared seed by seed: after equally many actions of learning."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from experiments.report.ratios import drives_at_equal_actions, newest_drives, ratios
from experiments.report.run_folder import Experiment, Rows
from tests.synthetic_runs import experiment


def test_equal_actions_are_those_of_the_seed_that_drove_less(tmp_path: Path) -> None:
    before, rmm = (experiment(tmp_path, name, (1, 2)) for name in ("plus-normm", "plus-rmm"))
    named = {"plus-normm": before, "plus-rmm": rmm}
    found = drives_at_equal_actions(rmm, before, named, "plus")
    for run, rival in zip(rmm.runs, before.runs, strict=True):
        ends = [int(r.evaluated("plus").rows[-1]["total_actions"]) for r in (run, rival)]
        for drives, side in zip(found, (run, rival), strict=True):
            until = [
                (float(row["bumps"]), float(row["actions"]))
                for row in side.evaluated("plus").rows
                if int(row["total_actions"]) <= min(ends)
            ]
            assert drives[run.info.seed] == until[-1]
    one = Experiment(before.runs[:1])
    drives = {each.name: newest_drives(each, "plus") for each in (rmm, one)}
    assert ratios("plus-rmm", ["plus-normm"], "plus", drives) == []


@pytest.mark.parametrize(("end", "theirs"), [(100, 10.0), (60, 20.0), (40, 30.0)])
def test_the_drives_of_a_predecessor_come_before(tmp_path: Path, end: int, theirs: float) -> None:
    def driven(name: str, *drives: tuple[int, float]) -> Experiment:
        (run,) = experiment(tmp_path, name).runs
        plain = run.evaluated("plus").rows[0]
        rows = tuple(
            plain | {"total_actions": str(actions), "bumps": str(bumps), "actions": "1000"}
            for actions, bumps in drives
        )
        return Experiment((replace(run, evaluations=Rows(rows)),))

    rmm = driven("plus-rmm", (0, 50.0), (end, 9.0))
    before = driven("plus-normm", (0, 60.0), (40, 30.0))
    after = driven("plus-normm-fit", (41, 20.0), (90, 10.0), (150, 5.0))
    found = drives_at_equal_actions(rmm, after, {"plus-normm": before}, "plus")
    assert found == ({1: (9.0, 1000.0)}, {1: (theirs, 1000.0)})
