"""The full report of runs: every figure of the thesis in our form, and what it does not show.

One HTML page that needs no other file, one Markdown page per experiment, and one per scale with
the comparisons. A figure whose data are missing is left out, with a line that says so.
"""

from collections.abc import Sequence
from importlib.resources.abc import Traversable
from pathlib import Path

from experiments.plans.plan import PLANS, presentations
from experiments.report import run_folder
from experiments.report.claims import claims_sections
from experiments.report.comparisons import compare_all
from experiments.report.document import Section, Table, html, markdown, table, write_pictures
from experiments.report.measures import evaluated, of_seeds, spread
from experiments.report.run_folder import Experiment
from experiments.report.sections import section_of

DRIVEN = {
    "bumps_per_1000": "bumps per 1,000 actions",
    "laps": "laps per 1,000 actions",
    "distance": "distance",
    "circling": "circling",
}
"""Figures of the newest frozen drive, and what the table calls them."""


def write_report(folders: Sequence[Path], out: Path) -> list[Path]:
    """Read runs from any of their folders, and write the whole report; the pages, HTML first.

    Raises ConfigError: a folder holds no run; StateError: a file of a run is damaged.
    """
    sections = all_sections(run_folder.load(folders))
    write_pictures(sections, out / "figures")
    pages = {"report.html": html("Results", sections)}
    pages |= {f"{each.name}.md": markdown([each], "figures", level=1) for each in sections}
    for name, text in pages.items():
        (out / name).write_text(text, encoding="utf-8")
    return [out / name for name in pages]


def all_sections(experiments: Sequence[Experiment], plans: Traversable = PLANS) -> list[Section]:
    """The overview, the thesis's claims, comparisons, every experiment; nothing is drawn yet."""
    shown = presentations({experiment.name for experiment in experiments}, plans)
    return [
        overview(experiments),
        *claims_sections(experiments, shown),
        *compare_all(experiments, shown),
        *(section_of(experiment, shown[experiment.name]) for experiment in experiments),
    ]


def overview(experiments: Sequence[Experiment]) -> Section:
    """Everything that was run: how it drives, what it cost, how to repeat it."""
    drives = test_drives(experiments)
    blocks = (_driven(experiments), _origins(experiments), *([drives] if drives.rows else []))
    return Section("runs", "All runs", blocks)


def _driven(experiments: Sequence[Experiment]) -> Table:
    """A row per experiment and corridor in which its frozen networks drove."""
    rows = []
    for experiment in experiments:
        for world in experiment.worlds:
            values = [of_seeds(experiment, evaluated(column, world)) for column in DRIVEN]
            seeds = str(max(len(each) for each in values))
            rows.append((experiment.full_name, world, seeds, *map(spread, values)))
    title = "Newest drives of the frozen networks: median of the seeds, lowest to highest"
    header = ("experiment", "frozen in", "seeds", *DRIVEN.values())
    return Table("drives", title, header, tuple(rows))


def _origins(experiments: Sequence[Experiment]) -> Table:
    """What every experiment cost, and how to repeat it."""
    return table("costs", "What was run, and what all seeds together cost", experiments, {
        "experiment": lambda e: e.full_name,
        "seeds": lambda e: ", ".join(
            f"{run.info.seed}{'' if run.info.complete else ' (not complete)'}" for run in e.runs
        ),
        "episodes": lambda e: f"{sum(len(run.episodes) for run in e.runs):,}",
        "of one action, %": lambda e: spread(of_seeds(e, lambda r: 100.0 * r.one_action_share)),
        "actions": lambda e: f"{sum(run.actions for run in e.runs):,}",
        "gradient steps": lambda e: f"{sum(run.train_steps for run in e.runs):,}",
        "hours": lambda e: f"{sum(run.info.seconds for run in e.runs) / 3600:.2f}",
        "command of the first seed": lambda e: f"`{e.first.command}`",
        "machine": lambda e: ", ".join(dict.fromkeys(run.info.machine for run in e.runs)),
        "commit": lambda e: ", ".join(dict.fromkeys(f"`{run.info.commit}`" for run in e.runs)),
    })  # fmt: skip


def test_drives(experiments: Sequence[Experiment]) -> Table:
    """How the test drives of every run went, a row a run (A45)."""
    runs = [run for experiment in experiments for run in experiment.runs if run.tours]
    return table("test-drives", "Test drives (A45)", runs, {
        "experiment": lambda run: run.info.experiment,
        "scale": lambda run: run.info.scale,
        "seed": lambda run: str(run.info.seed),
        "full and without a bump":
            lambda run: f"{sum(tour.passed for tour in run.tours)} of {len(run.tours)}",
        "without a bump":
            lambda run: f"{sum(not tour.bumps for tour in run.tours)} of {len(run.tours)}",
        "bumps of each": lambda run: ", ".join(str(tour.bumps) for tour in run.tours),
    })  # fmt: skip
