"""Kept results: archives of small files, and the page that follows from them alone."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from shared.errors import StateError
from tests.synthetic_runs import write_run
from tools import archives, results

NAMES = ("policy-eps-greedy", "policy-roulette")
TEMPLATE = """# A page

<!-- show: policy-roulette-tenth-fitness -->

Text by hand.

<!-- show: drives -->
"""


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def docs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two experiments of two seeds kept, and the page written."""
    folder = tmp_path_factory.mktemp("kept")
    for name in NAMES:
        for seed in (1, 2):
            write_run(folder / "runs", name, seed)
    archives.keep([folder / "runs"], folder / "docs" / "results", arrays=False)
    (folder / "docs" / "results" / "page.template").write_text(TEMPLATE)
    results.write_results_page(folder / "docs")
    return folder / "docs"


def test_the_page_follows_from_what_is_kept(docs: Path) -> None:
    before = contents(docs)
    (docs / "results.md").unlink()
    (docs / "images" / "results" / "stale.png").write_bytes(b"")
    results.write_results_page(docs)
    assert contents(docs) == before


def test_figures_and_tables_stand_where_the_text_says(docs: Path) -> None:
    page = (docs / "results.md").read_text()
    places = [
        page.index(text)
        for text in (
            "# A page",
            "![Fitness]",
            "The highest mean fitness",
            "Text by hand.",
            "| poli",
        )
    ]
    assert places == sorted(places)
    assert "<!-- show" not in page
    shown = set(re.findall(r"\]\(images/results/([^)]+)\)", page))
    assert shown == {path.name for path in (docs / "images" / "results").iterdir()}
    assert shown == {"policy-roulette-tenth-fitness.png"}


def test_a_figure_that_no_kept_run_gives_is_named(docs: Path, tmp_path: Path) -> None:
    for path in (docs / "results").glob("*.tar.xz"):
        (tmp_path / "results").mkdir(exist_ok=True)
        (tmp_path / "results" / path.name).write_bytes(path.read_bytes())
    (tmp_path / "results" / "page.template").write_text("<!-- show: demo-full-fitness -->")
    with pytest.raises(StateError, match="no kept run gives a figure or table demo-full-fitness"):
        results.write_results_page(tmp_path)
    assert not (tmp_path / "results.md").exists()


def test_the_command_refuses_in_one_line(tmp_path: Path) -> None:
    app = typer.Typer()
    app.command()(results.main)
    told = CliRunner().invoke(app, [str(tmp_path), "--docs", str(tmp_path)])
    assert told.exit_code == 2
    assert told.stderr.startswith("results: ")
    assert "expected the folder of a run" in told.stderr
    assert told.stderr.count("\n") == 1


def test_the_page_in_the_repository_is_the_one_of_the_kept_files() -> None:
    text, pictures = results.results_page(results.DOCS)
    assert (results.DOCS / "results.md").read_text() == text
    drawn = {path.stem for path in (results.DOCS / "images" / "results").glob("*.png")}
    assert drawn == {picture.name for picture in pictures}
