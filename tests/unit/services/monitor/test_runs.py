"""Run folders: found, listed, compared and pruned; what is up stays."""

from __future__ import annotations

import io
from pathlib import Path

import pytest

from services.cli import main as cli
from services.monitor.running import locked
from shared import roles, run_record, settings
from shared.place import in_use


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Two runs below `runs/`, one of them far below."""
    monkeypatch.chdir(tmp_path)
    made = [Path("runs/demo"), Path("runs/experiments/plus-tenth/seed-3")]
    for number, folder in enumerate(made):
        config = settings.load("demo", overrides=[f"run.seed={number}"])
        settings.claim(folder, config)
        run_record.begin(folder, config)
        row = {"episode": 1, "fitness": 12, "total_actions": 12, "laps_left": 2, "laps_right": 1}
        run_record.write_csv(
            folder / "episodes.csv", run_record.EPISODE_COLUMNS, [{**row, "seconds": 1.0}]
        )
        (folder / "roles").mkdir()
        (folder / "roles" / "replay-main.lock").touch()
        (folder / "tensorboard").mkdir()
        (folder / "tensorboard" / "events.1").write_bytes(bytes(100_000))
        (folder / "logs").mkdir()
        for name in ("up.log", "up.log.1"):
            (folder / "logs" / name).write_text("text\n")
    return made


def test_runs_are_listed_with_their_figures(
    folders: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    (folders[1] / "run.json").write_text("{}")
    with locked(folders[0]):
        assert cli.main(["runs"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    for part in ("runs/demo", "services", "12.0", "2 left 1 right", "MB", "up"):
        assert part in lines[1]
    assert "damaged" in lines[2]


def test_one_is_shown_against_the_defaults_and_two_against_each_other(
    folders: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["runs", "show", str(folders[0])]) == 0
    shown = capsys.readouterr().out
    for part in ("memory.capacity", "4000", "commit", "total_actions", "fitness"):
        assert part in shown
    assert cli.main(["runs", "compare", *map(str, folders)]) == 0
    shown = capsys.readouterr().out
    assert "run.seed" in shown
    assert "memory.capacity" not in shown
    assert cli.main(["runs", "show"]) == 2
    assert cli.main(["runs", "compare", "nowhere"]) == 2


def test_what_can_be_spared_goes_after_asking_and_never_of_a_run_that_is_up(
    folders: list[Path], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())
    board, old = folders[0] / "tensorboard", folders[0] / "logs" / "up.log.1"
    assert cli.main(["runs", "prune"]) == 1  # nobody answers
    assert board.exists()
    with locked(folders[1]):
        assert cli.main(["runs", "prune", "--yes"]) == 0
    output = capsys.readouterr().out
    assert f"{folders[1]}: up, left alone" in output
    assert "0.1 MB freed" in output
    assert not board.exists()
    assert not old.exists()
    assert (folders[0] / "logs" / "up.log").exists()
    assert (folders[1] / "tensorboard").exists()
    assert cli.main(["runs", "prune", "--whole", "--yes"]) == 2  # none is named
    assert cli.main(["runs", "prune", "--whole", "--yes", str(folders[0])]) == 0
    assert [folder.exists() for folder in folders] == [False, True]


def test_a_service_alone_uses_its_folder(folders: list[Path]) -> None:
    assert not in_use(folders[0])
    with roles.locked(folders[0], "replay", "main", "a" * 12):
        assert in_use(folders[0])
    assert not in_use(folders[0])
