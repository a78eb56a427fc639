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


def write_report(
    folders: Sequence[Path], out: Path, gpu_step_ms: float | None = None
) -> list[Path]:
    """Read runs and write the whole report.

    Args:
        folders: Folders of seeds, of experiments, or of several experiments.
        out: Where the pages are written; the folder is made if it is missing.
        gpu_step_ms: Measured time of a gradient step on a GPU; adds projected hours.

    Returns:
        The pages written, HTML first.

    Raises:
        ConfigError: A folder holds no run.
        StateError: A file of a run is damaged.
    """
    sections = all_sections(run_folder.load(folders), gpu_step_ms)
    write_pictures(sections, out / "figures")
    page = out / "report.html"
    page.write_text(html("Results", sections), encoding="utf-8")
    written = [page]
    for section in sections:
        path = out / f"{section.name}.md"
        path.write_text(markdown([section], "figures", level=1), encoding="utf-8")
        written.append(path)
    return written


def all_sections(
    experiments: Sequence[Experiment], gpu_step_ms: float | None = None, plans: Traversable = PLANS
) -> list[Section]:
    """The overview, the thesis's claims, comparisons, every experiment; nothing is drawn yet.

    Args:
        experiments: What was run.
        gpu_step_ms: As for `write_report`.
        plans: The folder of plans, which tell how experiments are shown.
    """
    shown = presentations({experiment.name for experiment in experiments}, plans)
    return [
        overview(experiments, gpu_step_ms, plans),
        *claims_sections(experiments, shown),
        *compare_all(experiments, shown),
        *(section_of(experiment, shown[experiment.name]) for experiment in experiments),
    ]
