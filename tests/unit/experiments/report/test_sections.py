"""The section of an experiment: every figure where its data are, a line where they are not."""

from __future__ import annotations

from pathlib import Path

from experiments.plans.plan import presentations
from experiments.records import EVALUATION_COLUMNS
from experiments.report.document import Picture, Section, Table
from experiments.report.figures.drives import BUMPS, COVERAGE, DISTANCE, LAPS, panels
from experiments.report.run_folder import Experiment, load, read_run
from experiments.report.sections import section_of
from shared.run_record import write_csv
from tests.synthetic_runs import experiment, missing, sentences, titles, write_route, write_run


def shown_alone(shown: Experiment) -> Section:
    return section_of(shown, presentations([shown.name])[shown.name])


def test_an_experiment_shows_its_figures_of_the_thesis(tmp_path: Path) -> None:
    section = shown_alone(experiment(tmp_path, "plus-rmm"))
    assert titles(section)[:3] == [
        "Fitness (Fig 4.9a)",
        "Loss (Fig 4.9b)",
        "Memory by action (Fig 4.11)",
    ]
    assert missing(section) == []
    table = next(block for block in section.blocks if isinstance(block, Table))
    assert ("episodes", "7,000", "700", "700") in table.rows


def test_two_corridors_show_their_samples_and_predictions(tmp_path: Path) -> None:
    section = shown_alone(experiment(tmp_path, "plus-minus"))
    assert "Memory by corridor (Fig 4.15)" in titles(section)
    assert "Predicted rewards in minus, last weights (Fig 4.17)" in titles(section)


def test_coverage_stands_where_no_lap_can_be_driven(tmp_path: Path) -> None:
    found = experiment(tmp_path, "plus-minus")
    assert panels([found], "plus") == (BUMPS, LAPS, DISTANCE)
    assert panels([found], "minus") == (BUMPS, COVERAGE, DISTANCE)


def test_much_circling_is_told_aloud(tmp_path: Path) -> None:
    folder = experiment(tmp_path, "policy-roulette").runs[0].folder
    for circling, warned in (("0.02", False), ("0.9", True)):
        rows = [dict(row) for row in read_run(folder).evaluations.rows]
        for row in rows:
            row["circling"] = circling
        write_csv(folder / "evaluations.csv", EVALUATION_COLUMNS, rows)
        (found,) = load([folder])
        assert ("Mind the circling" in sentences(shown_alone(found))) == warned


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    found = experiment(tmp_path, "i16c")
    for path in found.runs[0].folder.iterdir():
        if path.name != "run.json":
            path.unlink()
    info = found.runs[0].folder / "run.json"
    info.write_text(info.read_text().replace('"i16c"', '"i16c-test"').replace("true", "false"))
    (bare,) = load([tmp_path])
    section = shown_alone(bare)
    assert titles(section) == []
    assert missing(section) == [
        "the thesis's numbers",
        "fitness and loss over episodes",
        "samples in the memory",
        "drives of the frozen network",
        "predicted rewards",
        "route (Fig 4.20)",
    ]
    assert "Seed 1 is not complete: 0 episodes so far." in sentences(section)


def test_a_route_names_its_events(tmp_path: Path) -> None:
    folder = write_run(tmp_path, "i16c", 1)
    write_route(folder / "route-tour.npz", "plus", [(1.2, 1.2), (1.5, 1.2), (1.9, 1.2)])
    (found,) = load([tmp_path])
    shown = [b for b in shown_alone(found).blocks if isinstance(b, Picture)]
    assert shown[-1].title == "Route in plus (Fig 4.20)"
    assert "2 actions, 1 bump." in shown[-1].caption
    assert "1 (action 1) passes the window; 2 (action 2) turns." in shown[-1].caption
