"""The table of frozen drives: a row a seed, then floor and ceiling, and when a lap came first."""

from __future__ import annotations

import json
from pathlib import Path

from experiments.records import EVALUATION_COLUMNS, read_csv, write_csv
from experiments.runs import load
from experiments.tables import frozen
from tests.synthetic_runs import write_run


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
    info = tmp_path / "plus-rmm-mini" / "seed-2" / "run.json"
    told = json.loads(info.read_text())
    told["first_lap"] = {"seconds": 61.5, "actions": 8123, "episode": 40, "train_steps": 94}
    info.write_text(json.dumps(told))
    info = tmp_path / "plus-rmm-mini" / "seed-1" / "run.json"
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
