"""What the folder of a run tells the page: curves as they grow, obstacles, notes, maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from services.page import folder as module
from services.page.folder import POINTS, Folder, map_of, moving
from shared import statefile
from shared.run_record import EPISODES, REPLAY_COLUMNS, TRAINING, TRAINING_COLUMNS, append_csv

BOX = {"name": "box1", "x_m": 1.0, "y_m": 2.0, "length_m": 0.4, "width_m": 0.2, "height_m": 0.5}


def write(run: Path, first: int, last: int) -> None:
    rows = [
        {"episode": n, "fitness": n, "bump": n % 2, "actions": 100, "threshold_percent": 1,
         "forward": n, "by_world": f"plus={n} minus=3"}
        for n in range(first, last + 1)
    ]  # fmt: skip
    append_csv(run / EPISODES, REPLAY_COLUMNS, rows)
    append_csv(run / TRAINING, TRAINING_COLUMNS, [{"episode": last, "loss": 0.5}])


def test_curves_are_read_as_they_grow_and_anew_when_written_anew(tmp_path: Path) -> None:
    run = Folder(tmp_path)
    assert run.curves() is None
    write(tmp_path, 1, 4)
    curves = run.curves()
    assert curves is not None
    assert curves["fitness"] == {"x": [1, 2, 3, 4], "y": {"mean": [1.0, 1.5, 2.0, 2.5]}}
    assert curves["worlds"]["y"] == {"plus": [1.0, 2.0, 3.0, 4.0], "minus": [3.0] * 4}
    assert curves["loss"] == {"x": [4], "y": {"loss": [0.5]}}
    assert curves["laps"]["y"]["left"] == [None] * 4
    assert run.curves() is None
    with (tmp_path / EPISODES).open("a") as stream:
        stream.write("5,run")  # a torn line
    assert run.curves() is None
    (tmp_path / EPISODES).unlink()
    write(tmp_path, 1, 1000)
    curves = run.curves()
    assert curves is not None
    assert (len(curves["fitness"]["x"]), curves["fitness"]["x"][-1]) == (POINTS, 1000)
    assert curves["bumps"]["y"]["bumps"][-1] == 5.0


def test_a_moving_mean_weighs_at_most_its_window() -> None:
    found = moving(np.array([1.0, 0.0, 0.0, 1.0]), np.array([5.0, 5.0, 5.0, 5.0]), 10.0)
    assert found.tolist() == [0.2, 0.1, 0.0, 0.1]
    assert moving(np.zeros(0), np.zeros(0), 10.0).tolist() == []


def test_obstacles_are_those_that_the_driver_wrote_down(tmp_path: Path) -> None:
    run, box = Folder(tmp_path), {**BOX, "heading_deg": 0.0, "rgb": [1, 2, 3]}
    assert run.obstacles("r1", "plus") == []
    path = tmp_path / "robot" / "r1" / "world.msgpack"
    statefile.save(path, {"world": "plus", "obstacles": [box], "pending": []})
    assert run.obstacles("r1", "plus") == [
        {"name": "box1", "corners": [[0.8, 1.9], [1.2, 1.9], [1.2, 2.1], [0.8, 2.1]]}
    ]
    assert run.obstacles("r1", "minus") == []  # it has changed worlds since
    path.write_bytes(b"\xff")
    assert run.obstacles("r1", "plus") == []
    assert path.exists()  # it is the driver's to set aside


def test_notes_are_kept_up_to_a_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = Folder(tmp_path)
    assert run.notes() == []
    assert run.note("it \n circles", 12) == "kept at episode 12"
    (note,) = run.notes()
    assert (note["text"], note["episode"]) == ("it \n circles", 12)
    monkeypatch.setattr(module, "MOST_BYTES", 100)
    assert run.note("x" * 100, 13).startswith("NOT kept")
    assert len(run.notes()) == 1


def test_a_world_has_a_map_and_an_unknown_one_has_none() -> None:
    plus = map_of("plus")
    assert plus is not None
    assert plus["walls"]
    assert map_of("nowhere") is None
