"""Numbers of runs: equal actions, what was kept, how numbers are written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments.report.measures import (
    at_equal_actions,
    difference_at_equal_actions,
    kept,
    number,
    spread,
    ways_between_bumps,
)
from experiments.report.run_folder import Experiment, Rows
from tests.synthetic_runs import experiment


def test_equal_actions_are_those_of_the_seed_that_drove_less(tmp_path: Path) -> None:
    before, rmm = (experiment(tmp_path, name, (1, 2)) for name in ("plus-normm", "plus-rmm"))
    named = {"plus-normm": before, "plus-rmm": rmm}
    for each, run, rival in zip(
        at_equal_actions(rmm, before, named, "plus"), rmm.runs, before.runs, strict=True
    ):
        ends = [int(r.evaluated("plus").rows[-1]["total_actions"]) for r in (run, rival)]
        assert each.actions == min(ends)
        for value, side in ((each.ours, run), (each.theirs, rival)):
            until = [
                float(row["bumps_per_1000"])
                for row in side.evaluated("plus").rows
                if int(row["total_actions"]) <= each.actions
            ]
            assert value == until[-1]
    assert difference_at_equal_actions("plus-rmm", "plus-normm", "plus", [each]) is None


@pytest.mark.parametrize(("end", "theirs"), [(100, 10.0), (60, 20.0), (40, 30.0)])
def test_the_drives_of_a_predecessor_come_before(tmp_path: Path, end: int, theirs: float) -> None:
    def driven(name: str, *drives: tuple[int, float]) -> Experiment:
        (run,) = experiment(tmp_path, name).runs
        plain = run.evaluated("plus").rows[0]
        rows = tuple(
            plain | {"total_actions": str(actions), "bumps_per_1000": str(bumps)}
            for actions, bumps in drives
        )
        return Experiment((replace(run, evaluations=Rows(rows)),))

    rmm = driven("plus-rmm", (0, 50.0), (end, 9.0))
    before = driven("plus-normm", (0, 60.0), (40, 30.0))
    after = driven("plus-normm-fit", (41, 20.0), (90, 10.0), (150, 5.0))
    (found,) = at_equal_actions(rmm, after, {"plus-normm": before}, "plus")
    assert (found.seed, found.actions, found.ours, found.theirs) == (1, end, 9.0, theirs)


def test_what_was_kept_compares_the_drives_around_the_other_corridor(tmp_path: Path) -> None:
    before = experiment(tmp_path, "plus-rmm").runs[0]
    run = experiment(tmp_path, "plus-minus").runs[0]
    entry = kept(run, "plus", before)
    assert entry is not None
    drives = run.evaluated("plus")
    within = drives.numbers("episode") <= run.info.stages[0].last_episode
    assert entry.after == ways_between_bumps(drives)[within][-1]
    assert entry.before == ways_between_bumps(before.evaluated("plus"))[-1]
    assert kept(run, "plus", None) is None  # it did not drive before its first episode
    assert kept(before, "plus", None) is None  # it never left


def test_numbers_are_written_with_three_digits() -> None:
    assert [number(x) for x in (1234.5, 12.345, 3.0, -0.5, float("nan"))] == [
        "1,234", "12.3", "3", "−0.5", "-",
    ]  # fmt: skip
    assert spread(np.array([3.0, 1.0, 2.0])) == "2 (1 to 3)"
    assert spread(np.array([])) == "-"


def test_the_way_between_bumps_counts_up_to_500_actions() -> None:
    rows = [{"actions": "1000", "bumps": bumps} for bumps in ("0", "1", "4")]
    assert ways_between_bumps(Rows(tuple(rows))).tolist() == [500, 500, 250]


def test_what_was_kept_is_looked_at_around_the_first_part_elsewhere(tmp_path: Path) -> None:
    """Also where the run itself learned the corridor before, and learns it again after."""
    (run,) = experiment(tmp_path, "plus-minus").runs
    first = run.info.stages[0]
    names = (("plus", 10), ("minus", 20), ("plus", 30), ("i16c", 40))
    stages = tuple(
        first.model_copy(update={"world": world, "first_episode": end - 9, "last_episode": end})
        for world, end in names
    )
    rows = tuple(
        {**run.evaluations.rows[0], "driver": "network", "world": "plus", "episode": str(end),
         "actions": "1000", "bumps": str(bumps)}
        for end, bumps in ((10, 4), (20, 8), (30, 5), (40, 100))
    )  # fmt: skip
    info = run.info.model_copy(update={"stages": stages})
    entry = kept(replace(run, info=info, evaluations=Rows(rows)), "plus", None)
    assert entry is not None
    assert (entry.before, entry.after, entry.share) == (250.0, 125.0, 0.5)
