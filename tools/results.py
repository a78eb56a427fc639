"""The page of results: text by hand, with figures and tables of the runs kept with the code.

    python -m tools.results [RUNS]... [--arrays]

adds RUNS to the archives in `docs/results/` and writes `docs/results.md` and its pictures anew.
Without RUNS it writes the page from what is kept, which gives the same page again. The text is
`docs/results/page.template`. A line `<!-- show: NAME -->` in it stands for the figure or table of
this name and the findings about it. Names are those of the full report (`corridor report`).
"""

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from experiments.report.document import Block, Findings, Picture, Section, Table, block_text
from experiments.report.full_report import all_sections
from shared.errors import CorridorError, StateError
from tools import archives
from tools.retention import kept_section

DOCS = Path(__file__).parents[1] / "docs"
NOTICE = "<!-- Written by `python -m tools.results` from `docs/results/`. -->\n\n"
_SHOWN = re.compile(r"<!-- show: (\S+) -->")


def write_results_page(docs: Path) -> None:
    """Write `results.md` and its pictures from what is kept, and remove other pictures.

    Raises StateError: an archive is damaged, or the text names what no kept run gives.
    """
    text, shown = results_page(docs)
    images = docs / "images" / "results"
    images.mkdir(parents=True, exist_ok=True)
    for path in images.glob("*.png"):
        path.unlink()
    for picture in shown:
        (images / f"{picture.name}.png").write_bytes(picture.image)
    (docs / "results.md").write_text(text, encoding="utf-8")


def results_page(docs: Path) -> tuple[str, list[Picture]]:
    """Text of the page and the pictures it shows, not drawn yet. Raises as `write_results_page`."""
    source = docs / "results" / "page.template"
    kept = sorted((docs / "results").glob(f"*{archives.SUFFIX}"))
    sections = [*all_sections(archives.load(kept)), *kept_section(docs / "results")]
    named = _named_blocks(sections)
    pictures: list[Picture] = []

    def shown(match: re.Match[str]) -> str:
        if match[1] not in named:
            raise StateError(f"{source}: no kept run gives a figure or table {match[1]}")
        blocks = named[match[1]]
        pictures.extend(block for block in blocks if isinstance(block, Picture))
        return "\n\n".join(block_text(block, "images/results") for block in blocks)

    return NOTICE + _SHOWN.sub(shown, source.read_text(encoding="utf-8")), pictures


def _named_blocks(sections: Sequence[Section]) -> dict[str, list[Block]]:
    """Every figure and table by its name, each with the findings right after it."""
    named: dict[str, list[Block]] = {}
    for section in sections:
        current: list[Block] = []
        for block in section.blocks:
            if isinstance(block, Picture | Table):
                current = named[block.name] = [block]
            elif isinstance(block, Findings):
                current.append(block)
            else:
                current = []
    return named


def main(
    runs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[RUNS]...", help="Folders of runs to keep; none: write only."),
    ] = None,
    docs: Annotated[Path, typer.Option(help="The folder of the pages.")] = DOCS,
    arrays: Annotated[
        bool, typer.Option("--arrays", help="Keep predictions and routes of the lowest seed, too.")
    ] = False,
) -> None:
    """Keep small files of runs, and write the page of results from everything that is kept."""
    try:
        if runs:
            archives.keep(runs, docs / "results", arrays=arrays)
        write_results_page(docs)
    except CorridorError as error:
        typer.echo(f"results: {error}", err=True)
        sys.exit(2)
    typer.echo(f"written: {docs / 'results.md'}")


if __name__ == "__main__":
    typer.run(main)
