"""Numbers of runs: what was kept, how numbers are written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.report.measures import kept, number, spread, ways_between_bumps
from experiments.report.run_folder import Rows
from tests.synthetic_runs import experiment


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
