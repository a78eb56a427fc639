"""The full report of runs: every figure of the thesis in our form, and what it does not show.

One HTML page that needs no other file, one Markdown page per experiment, and one per scale with
the comparisons. A figure whose data are missing is left out, with a line that says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources.abc import Traversable
from pathlib import Path

from experiments.plans.plan import PLANS, presentations
from experiments.report import run_folder
from experiments.report.claims import claims_sections
from experiments.report.comparisons import compare_all
from experiments.report.document import Section, html, markdown, write_pictures
from experiments.report.overview import overview
from experiments.report.run_folder import Experiment
from experiments.report.sections import section_of


def write_report(folders: Sequence[Path], out: Path) -> list[Path]:
    """Read runs and write the whole report.

    Args:
        folders: Folders of seeds, of experiments, or of several experiments.
        out: Where the pages are written; the folder is made if it is missing.

    Returns:
        The pages written, HTML first.

    Raises:
        ConfigError: A folder holds no run.
        StateError: A file of a run is damaged.
    """
    sections = all_sections(run_folder.load(folders))
    write_pictures(sections, out / "figures")
    page = out / "report.html"
    page.write_text(html("Results", sections), encoding="utf-8")
    written = [page]
    for section in sections:
        path = out / f"{section.name}.md"
        path.write_text(markdown([section], "figures", level=1), encoding="utf-8")
        written.append(path)
    return written


def all_sections(experiments: Sequence[Experiment], plans: Traversable = PLANS) -> list[Section]:
    """The overview, the thesis's claims, comparisons, every experiment; nothing is drawn yet.

    Args:
        experiments: What was run.
        plans: The folder of plans, which tell how experiments are shown.
    """
    shown = presentations({experiment.name for experiment in experiments}, plans)
    return [
        overview(experiments),
        *claims_sections(experiments, shown),
        *compare_all(experiments, shown),
        *(section_of(experiment, shown[experiment.name]) for experiment in experiments),
    ]
