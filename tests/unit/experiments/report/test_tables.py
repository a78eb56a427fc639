"""Tables: frozen drives with floor and ceiling, variants of the demo, test drives."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.records import EVALUATION_COLUMNS
from experiments.report.comparisons import memories
from experiments.report.full_report import all_sections, overview
from experiments.report.full_report import test_drives as table_of_test_drives
from experiments.report.run_folder import load
from experiments.report.sections import frozen, tours
from shared.errors import StateError
from shared.run_record import read_csv, write_csv
from tests.synthetic_runs import write_run

LAP = {"seconds": 61.5, "actions": 8123, "episode": 40, "train_steps": 94}
TOUR = {
    "passed": True, "driven": 412, "turned": 60, "bumps": 0, "route_share": 0.62,
    "bridges": ["east-bridge", "west-bridge"], "box_dropped": True,
}  # fmt: skip


def test_every_seed_and_both_references_have_a_row(tmp_path: Path) -> None:
    for seed in (1, 2):
        folder = write_run(tmp_path, "plus-rmm", seed)
        path = folder / "evaluations.csv"
        rows = [dict(row) for row in read_csv(path, EVALUATION_COLUMNS)]
        newest = [row for row in rows if row["driver"] == "network" and row["world"] == "plus"][-1]
        newest["bumps_per_1000"] = f"{seed}.5"
        kept = [row for row in rows if row["driver"] == "network"]
        made = [
            {**newest, "driver": d, "bumps_per_1000": b}
            for d, b in (("random", 77), ("planner", 0))
        ]
        write_csv(path, EVALUATION_COLUMNS, [*kept, *made])
    info = tmp_path / "plus-rmm-tenth" / "seed-2" / "run.json"
    told = json.loads(info.read_text())
    told["first_lap"] = {"seconds": 61.5, "actions": 8123, "episode": 40, "train_steps": 94}
    info.write_text(json.dumps(told))
    info = tmp_path / "plus-rmm-tenth" / "seed-1" / "run.json"
    told = json.loads(info.read_text())
    told["first_lap"] = {}
    info.write_text(json.dumps(told))
    (experiment,) = load([tmp_path])
    table = frozen(experiment, "plus")
    place = table.header.index("bumps per 1,000")
    assert [(row[0], row[1], row[2], row[place]) for row in table.rows] == [
        ("seed 1", "not yet", "not yet", "1.5"),
        ("seed 2", "61.5", "8,123", "2.5"),
        ("random actions", "-", "-", "77"),
        ("planner that knows the map", "-", "-", "0"),
    ]


def test_where_no_lap_was_looked_for_there_is_no_column(tmp_path: Path) -> None:
    folder = write_run(tmp_path, "plus-rmm", 1)
    told = json.loads((folder / "run.json").read_text())
    told.pop("first_lap", None)
    (folder / "run.json").write_text(json.dumps(told))
    (experiment,) = load([tmp_path])
    assert "first lap after s" not in frozen(experiment, "plus").header


def test_every_test_drive_has_a_row_and_a_damaged_file_is_named(tmp_path: Path) -> None:
    folder = write_run(tmp_path, "i16c-test", 1)
    path = folder / "tours.json"
    drives = [TOUR, {**TOUR, "passed": False, "route_share": 0.3, "bridges": []},
              {**TOUR, "passed": False, "bumps": 2, "box_dropped": False}]  # fmt: skip
    path.write_text(json.dumps(drives))
    (experiment,) = load([tmp_path])
    table = tours(experiment)
    assert [row[1:3] + row[5:] for row in table.rows] == [
        ("tour-0", "yes", "0", "62 %", "east-bridge, west-bridge", "yes"),
        ("tour-1", "no", "0", "30 %", "-", "yes"),
        ("tour-2", "no", "2", "62 %", "east-bridge, west-bridge", "no"),
    ]
    (counted,) = table_of_test_drives([experiment]).rows
    assert counted == ("i16c-test", "tenth", "1", "1 of 3", "2 of 3", "0, 0, 2")
    assert any(getattr(block, "rows", ()) == (counted,) for block in overview([experiment]).blocks)
    section = all_sections([experiment])[-1]
    assert any(block == table for block in section.blocks)
    path.write_text('[{"passed": 1}]')
    with pytest.raises(StateError, match=r"tours\.json"):
        load([tmp_path])


def test_memories_are_told_of_where_runs_tell(tmp_path: Path) -> None:
    for seed, left in ((1, 0.25), (2, 0.75)):
        memory = {"of_fill": left, "negative": 0.5, "mean_reward": 0.125}
        write_run(tmp_path, "plus-rmm", seed, memory=memory)
    write_run(tmp_path, "plus-normm", 1)
    (found,) = [e for e in load([tmp_path]) if e.name == "plus-rmm"]
    actions = [run.actions / 4500 for run in found.runs]
    (row,) = memories(load([tmp_path]), "tenth").rows
    assert row[:2] == ("plus-rmm", "1, 2")
    assert row[2].startswith(f"{np.median(actions):.3g}")
    assert row[3:] == ("50 (25 to 75)", "50 (50 to 50)", "0.125 (0.125 to 0.125)")


def test_figures_of_a_memory_that_cannot_be_are_refused(tmp_path: Path) -> None:
    write_run(tmp_path, "plus-rmm", 1, memory={"of_fill": 2, "negative": 0, "mean_reward": 0})
    with pytest.raises(StateError, match=r"run\.json: memory\.of_fill"):
        load([tmp_path])
