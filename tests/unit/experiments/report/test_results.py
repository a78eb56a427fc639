"""Kept results: small files are copied, and the page follows from them alone."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from experiments.report import results
from experiments.report.document import pictures
from experiments.report.run_folder import load
from shared.errors import ConfigError
from tests.synthetic_runs import write_run

NAMES = ("policy-eps-greedy", "policy-roulette")


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def docs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two experiments of two seeds kept, their runs thrown away, and the page written."""
    folder = tmp_path_factory.mktemp("kept")
    for name in NAMES:
        for seed in (1, 2):
            write_run(folder / "runs", name, seed)
    results.keep([folder / "runs"], folder / "docs")
    for path in sorted((folder / "runs").rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    results.write_page(folder / "docs")
    return folder / "docs"


def test_the_page_follows_from_what_is_kept(docs: Path) -> None:
    before = contents(docs)
    (docs / "results.md").unlink()
    for path in (docs / "images" / "results").iterdir():
        path.unlink()
    results.write_page(docs)
    assert contents(docs) == before


def test_predictions_are_kept_of_the_lowest_seed_only(docs: Path) -> None:
    kept = docs / "results" / f"{NAMES[0]}-mini"
    assert sorted(path.name for path in (kept / "seed-1").iterdir()) == [
        "episodes.csv.gz", "evaluations.csv", "probes-best-plus.npz", "probes-learn-plus.npz",
        "run.json",
    ]  # fmt: skip
    assert sorted(path.name for path in (kept / "seed-2").iterdir()) == [
        "episodes.csv.gz", "evaluations.csv", "run.json",
    ]  # fmt: skip


def test_test_drives_are_kept_of_every_seed(tmp_path: Path) -> None:
    for seed in (1, 2):
        folder = write_run(tmp_path / "runs", "i16c-test", seed)
        (folder / "tours.json").write_text("[]")
    results.keep([tmp_path / "runs"], tmp_path / "docs")
    kept = tmp_path / "docs" / "results" / "i16c-test-mini"
    assert [(kept / f"seed-{seed}" / "tours.json").read_text() for seed in (1, 2)] == ["[]", "[]"]


def test_the_page_lists_every_run_and_shows_every_picture(docs: Path) -> None:
    page = (docs / "results.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith("| policy-")]
    for experiment in load([docs / "results"]):
        for run in experiment.runs:
            info = run.info
            name = f"| {info.experiment} | mini | {info.seed} |"
            assert any(f"{name} 3,600 | {run.actions:,} |" in row for row in rows)
            assert any(f"{name} yes | `{info.command}` |" in row for row in rows)
    shown = set(re.findall(r"\]\(images/results/([^)]+)\)", page))
    assert shown == {path.name for path in (docs / "images" / "results").iterdir()}


def test_keeping_a_seed_again_replaces_it(tmp_path: Path) -> None:
    docs = tmp_path / "docs"
    write_run(tmp_path / "a", NAMES[0], 1)
    results.keep([tmp_path / "a"], docs)
    newer = write_run(tmp_path / "b", NAMES[0], 1, commit="newer")
    (newer / "probes-best-plus.npz").unlink()
    results.keep([tmp_path / "b"], docs)
    (experiment,) = load([docs / "results"])
    assert experiment.first.commit == "newer"
    assert [probes.label for probes in experiment.runs[0].probes] == ["learn-plus"]


def test_too_much_is_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    docs = tmp_path / "docs"
    write_run(tmp_path / "runs", NAMES[0], 1)
    results.keep([tmp_path / "runs"], docs)
    before = contents(docs)
    monkeypatch.setattr(results, "LIMIT_BYTES", sum(map(len, before.values())) + 1000)
    write_run(tmp_path / "runs", NAMES[0], 2)
    with pytest.raises(ConfigError, match="keep fewer runs"):
        results.keep([tmp_path / "runs"], docs)
    with pytest.raises(ConfigError, match="keep fewer runs"):  # pictures count as well
        results.write_page(docs)
    assert contents(docs) == before


def test_without_runs_the_page_says_so(tmp_path: Path) -> None:
    results.write_page(tmp_path)
    assert "No run is kept yet." in (tmp_path / "results.md").read_text()


def test_the_command_refuses_in_one_line(tmp_path: Path) -> None:
    app = typer.Typer()
    app.command()(results.main)
    told = CliRunner().invoke(app, [str(tmp_path), "--docs", str(tmp_path)])
    assert told.exit_code == 2
    assert told.stderr.startswith("results: ")
    assert "expected the folder of a run" in told.stderr
    assert told.stderr.count("\n") == 1


def test_the_page_in_the_repository_is_the_one_of_the_kept_files() -> None:
    text, sections = results.page(results.DOCS)
    assert (results.DOCS / "results.md").read_text() == text
    drawn = {path.stem for path in (results.DOCS / "images" / "results").glob("*.png")}
    assert drawn == {picture.name for picture in pictures(sections)}
