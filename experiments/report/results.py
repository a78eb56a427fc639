"""Results that are kept with the code: small files of runs, and the page made from them.

    python -m experiments.report.results RUNS...

copies what figures need of these runs into `docs/results/<experiment>-<scale>/seed-<n>/` and writes
`docs/results.md` with its pictures anew. Without RUNS it writes the page from what is kept, which
gives the same page again, byte for byte.
"""

from __future__ import annotations

import gzip
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import typer

from experiments.report import pages, run_folder
from experiments.report.comparisons import compare_all
from experiments.report.document import Section, markdown, pictures
from experiments.report.run_folder import Run
from shared.errors import ConfigError, CorridorError

DOCS = Path(__file__).parents[2] / "docs"
LIMIT_BYTES = 15_000_000
"""Of kept files and pictures together: a repository is no archive."""
_INTRO = """# Results

Everything that was run, as figures, tables and findings. Written by `python -m experiments.report.results` from the files in the folder `results` beside this page, which were copied from the folders of runs; findings are sentences by fixed rules (`experiments/report/findings.py`), also where they contradict the thesis. The thesis shows single runs without seeds: shapes are compared, not digits.

"""  # noqa: E501
_NOTHING = "No run is kept yet.\n"

Files = Mapping[Path, bytes]


def keep(folders: Sequence[Path], docs: Path) -> None:
    """Copy what figures need of runs, in place of what was kept of the same seeds.

    Predictions and routes are kept of the lowest seed only: figures show no other.

    Raises:
        ConfigError: A folder holds no run, or more would be kept than allowed; nothing is written.
    """
    files: dict[Path, bytes] = {}
    replaced: set[Path] = set()
    for experiment in run_folder.load(folders):
        for run in experiment.runs:
            target = docs / "results" / experiment.full_name / f"seed-{run.info.seed}"
            replaced.add(target)
            files |= _small_files(run, target, arrays=run is experiment.runs[0])
    others = [path for path in _kept_files(docs) if path.parent not in replaced]
    _check_size(sum(len(data) for data in files.values()) + _size(others))
    for folder in replaced:
        for path in folder.glob("*"):
            path.unlink()
    _write(files)


def _small_files(run: Run, target: Path, arrays: bool) -> Files:
    """Contents by new path; gzipped without time and name, so that equal tables stay equal."""
    names = ["run.json", "evaluations.csv", "tours.json"]
    if arrays:
        names += [path.name for path in sorted(run.folder.glob("*.npz"))]
    files = {
        target / name: (run.folder / name).read_bytes()
        for name in names
        if (run.folder / name).exists()
    }
    table = run.folder / "episodes.csv"
    if table.exists():
        files[target / "episodes.csv.gz"] = gzip.compress(table.read_bytes(), mtime=0)
    return files


def write_page(docs: Path) -> None:
    """Write `results.md` and its pictures from what is kept, and remove pictures of before.

    Raises:
        ConfigError: Kept files and pictures are larger than allowed; nothing is written.
    """
    text, sections = page(docs)
    images = docs / "images" / "results"
    files = {images / f"{picture.name}.png": picture.image for picture in pictures(sections)}
    _check_size(_size((docs / "results").rglob("*")) + sum(len(data) for data in files.values()))
    for path in images.glob("*.png"):
        path.unlink()
    _write(files)
    (docs / "results.md").write_text(text, encoding="utf-8")


def page(docs: Path) -> tuple[str, list[Section]]:
    """Text of the page and what it is made of, from what is kept; nothing is drawn yet."""
    kept = sorted(path for path in (docs / "results").glob("*") if path.is_dir())
    if not kept:
        return _INTRO + _NOTHING, []
    experiments = run_folder.load(kept)
    overview = Section("runs", "All runs", pages.overview_blocks(experiments))
    parts = [pages.section_of(experiment) for experiment in experiments]
    sections = [overview, *compare_all(experiments), *parts]
    return _INTRO + markdown(sections, "images/results"), sections


def _kept_files(docs: Path) -> list[Path]:
    """What is there already, kept files and pictures."""
    return [*(docs / "results").rglob("*"), *(docs / "images" / "results").rglob("*")]


def _size(paths: Iterable[Path]) -> int:
    return sum(path.stat().st_size for path in paths if path.is_file())


def _check_size(total: int) -> None:
    if total > LIMIT_BYTES:
        raise ConfigError(
            f"results: expected at most {LIMIT_BYTES / 1e6:.0f} MB of kept files and pictures, "
            f"got {total / 1e6:.1f} MB; keep fewer runs"
        )


def _write(files: Files) -> None:
    for path, data in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def main(
    folders: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[RUNS]...", help="Folders of runs to be kept; none: only write."),
    ] = None,
    docs: Annotated[Path, typer.Option(help="Where the pages are.")] = DOCS,
) -> None:
    """Keep small files of runs and write the page of results from everything kept."""
    try:
        if folders:
            keep(folders, docs)
        write_page(docs)
    except CorridorError as error:
        typer.echo(f"results: {error}", err=True)
        sys.exit(2)
    typer.echo(f"written: {docs / 'results.md'}")


if __name__ == "__main__":
    typer.run(main)
