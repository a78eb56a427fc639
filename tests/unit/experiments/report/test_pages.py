"""The report: every figure where its data are, a line where they are not, sentences by rules."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments.records import EPISODE_COLUMNS, EVALUATION_COLUMNS, write_csv
from experiments.report import findings, pages
from experiments.report.comparisons import compare_all
from experiments.report.document import Findings, Missing, Picture, Section, Table, html, markdown
from experiments.report.figures.drives import BUMPS, COVERAGE, DISTANCE, LAPS, Compared, panels
from experiments.report.figures.probes import chosen
from experiments.report.measures import (
    at_equal_actions,
    difference_at_equal_actions,
    kept,
    number,
    spread,
)
from experiments.report.run_folder import Experiment, Rows, load, read_run
from experiments.report.statistics import Difference
from services.cli.main import main
from tests.synthetic_runs import write_probes, write_route, write_run

PNG = b"\x89PNG"


def experiment(out: Path, name: str, seeds: Sequence[int] = (1,)) -> Experiment:
    folders = [write_run(out, name, seed) for seed in seeds]
    (found,) = load(folders)
    return found


def titles(section: Section) -> list[str]:
    return [block.title for block in section.blocks if isinstance(block, Picture)]


def missing(section: Section) -> list[str]:
    return [block.what for block in section.blocks if isinstance(block, Missing)]


def sentences(section: Section) -> str:
    told = [block.sentences for block in section.blocks if isinstance(block, Findings)]
    return "\n".join(sentence for group in told for sentence in group)


def test_an_experiment_shows_its_figures_of_the_thesis(tmp_path: Path) -> None:
    section = pages.section_of(experiment(tmp_path, "plus-rmm"))
    assert titles(section)[:3] == [
        "Fitness (Fig 4.9a)",
        "Loss (Fig 4.9b)",
        "Memory by action (Fig 4.11)",
    ]
    assert missing(section) == []
    assert "balanced, as in the thesis" in sentences(section)
    assert "it fell, as in the thesis (Fig 4.9b)" in sentences(section)
    table = next(block for block in section.blocks if isinstance(block, Table))
    assert ("episodes", "7,000", "700", "700") in table.rows


def test_an_unbalanced_memory_is_called_so(tmp_path: Path) -> None:
    told = sentences(pages.section_of(experiment(tmp_path, "plus-normm")))
    assert "forward 55." in told
    assert "not balanced, as in the thesis" in told


def test_two_corridors_show_their_samples_and_predictions(tmp_path: Path) -> None:
    section = pages.section_of(experiment(tmp_path, "plus-minus"))
    assert "Memory by corridor (Fig 4.15)" in titles(section)
    assert "Predicted rewards in minus, last weights (Fig 4.17)" in titles(section)
    assert "more of Minus than of Plus, as in the thesis" in sentences(section)


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
        assert ("Mind the circling" in sentences(pages.section_of(found))) == warned


def test_seeds_that_favour_different_actions_are_not_balanced(tmp_path: Path) -> None:
    found = experiment(tmp_path, "policy-roulette", (1, 2))
    for run, favoured in zip(found.runs, ("left", "right"), strict=True):
        rows = [dict(row) for row in run.episodes.rows]
        rows[-1] |= {"left": "1000", "right": "1000", "forward": "1500", favoured: "2000"}
        write_csv(run.folder / "episodes.csv", EPISODE_COLUMNS, rows)
    (again,) = load([tmp_path])
    assert "not balanced" in sentences(pages.section_of(again))


def test_memories_that_did_not_begin_equal_are_told(tmp_path: Path) -> None:
    for name, fill in (("policy-roulette", "a"), ("policy-eps-greedy", "b")):
        write_run(tmp_path, name, 1, prefill="same")
        write_run(tmp_path, name, 2, prefill=fill)
    (section,) = compare_all(load([tmp_path]))
    assert "The memories did not begin equal in seed 2." in sentences(section)


def test_another_method_is_compared_at_its_scale(tmp_path: Path) -> None:
    for seed in (1, 2):
        write_run(tmp_path, "plus-rmm", seed)
        other = write_run(tmp_path / "other", "policy-roulette", seed)
        (other / "episodes.csv").unlink()
        info = json.loads((other / "run.json").read_text())
        left = {key: info[key] for key in info if key not in ("after", "prefill", "first_lap")}
        left |= {"experiment": "dqn-distance", "actions": 5000}
        (other / "run.json").write_text(json.dumps(left))
    found = load([tmp_path / "other", tmp_path / "plus-rmm-mini"])
    (section,) = compare_all(found)
    assert section.name == "comparisons-mini"
    assert "plus-rmm had fewer bumps than dqn-distance in plus" in sentences(section)
    assert found[0].runs[0].actions == 5000  # there are no episodes to add up


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    found = experiment(tmp_path, "i16c")
    for path in found.runs[0].folder.iterdir():
        if path.name != "run.json":
            path.unlink()
    info = found.runs[0].folder / "run.json"
    info.write_text(info.read_text().replace('"i16c"', '"i16c-test"').replace("true", "false"))
    (bare,) = load([tmp_path])
    section = pages.section_of(bare)
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
    shown = [b for b in pages.section_of(found).blocks if isinstance(b, Picture)]
    assert shown[-1].title == "Route in plus (Fig 4.20)"
    assert "2 actions, 1 bump, other than in the thesis." in shown[-1].caption
    assert "1 (action 1) passes the window; 2 (action 2) turns." in shown[-1].caption


def test_comparisons_are_drawn_when_all_their_experiments_are_there(tmp_path: Path) -> None:
    names = ("plus-normm", "plus-normm-fit", "plus-rmm", "plus-rmm-nopretrain", "plus-minus")
    all_of = [experiment(tmp_path, name, (1, 2)) for name in names]
    (section,) = compare_all(all_of)
    shown = "\n".join(titles(section))
    for figure in ("Fig 4.5", "Fig 4.12", "Fig 4.10", "Fig 4.16", "Differences"):
        assert figure in shown
    assert missing(section) == []
    assert "plus-rmm had fewer bumps than plus-normm in plus" in sentences(section)
    kept_table = next(b for b in section.blocks if isinstance(b, Table) and "Kept" in b.title)
    assert [row[0] for row in kept_table.rows] == ["1", "2"]


def test_comparisons_without_an_experiment_say_which(tmp_path: Path) -> None:
    pair = [experiment(tmp_path, name) for name in ("plus-normm", "plus-rmm")]
    (section,) = compare_all(pair)
    why = {block.what: block.why for block in section.blocks if isinstance(block, Missing)}
    assert "plus-normm-fit" in why["NoRMM going on with fitting phases (Fig 4.5)"]
    assert "1 and 1 seeds, at least 2 each needed" in why["difference of bumps"]
    assert "Predicted rewards in plus, plus-rmm and plus-normm (Fig 4.10)" in titles(section)


def test_networks_asked_about_different_images_are_not_compared(tmp_path: Path) -> None:
    write_run(tmp_path, "plus-normm", 1)
    other = write_run(tmp_path, "plus-rmm", 1)
    write_probes(other / "probes-best-plus.npz", "plus", np.random.default_rng(1), count=7)
    (section,) = compare_all(load([tmp_path]))
    assert any("different images" in b.why for b in section.blocks if isinstance(b, Missing))


def test_one_experiment_is_not_compared(tmp_path: Path) -> None:
    assert compare_all([experiment(tmp_path, "i16c")]) == []


def test_more_experiments_than_colours_share_no_figure(tmp_path: Path) -> None:
    for count in (6, 7):
        folder = tmp_path / str(count)
        for variant in range(count):
            for seed in (1, 2):
                write_run(folder, f"search-{variant}", seed)
        (section,) = compare_all(load([folder]))
        shared = [title for title in titles(section) if title.startswith("Frozen evaluation")]
        left_out = [what for what in missing(section) if what.startswith("frozen evaluation of")]
        assert (len(shared), len(left_out)) == ((1, 0) if count == 6 else (0, 1))
        assert "Differences between experiments" in titles(section)


def test_variants_are_compared_with_what_they_vary(tmp_path: Path) -> None:
    names = ("search-fast", "search-demo", "search-normm", "plus-rmm-quotas", "plus-rmm-nopretrain")
    (section,) = compare_all([experiment(tmp_path, name, (1, 2)) for name in names])
    lines = [line for line in sentences(section).splitlines() if "interval of" in line]
    pairs = sorted(line.split("interval of ")[1].split(" is ")[0] for line in lines)
    assert pairs == [
        "plus-rmm-nopretrain − plus-rmm-quotas",
        "search-demo − search-fast",
        "search-demo − search-normm",
    ]


def test_equal_actions_are_those_of_the_seed_that_drove_less(tmp_path: Path) -> None:
    before, rmm = (experiment(tmp_path, name, (1, 2)) for name in ("plus-normm", "plus-rmm"))
    named = {"plus-normm": before, "plus-rmm": rmm}
    for each, run, rival in zip(
        at_equal_actions(rmm, before, named, "plus"), rmm.runs, before.runs, strict=True
    ):
        ends = [int(r.evaluated("plus").rows[-1]["total_actions"]) for r in (run, rival)]
        assert each.actions == min(ends)
        for value, side in ((each.ours, run), (each.theirs, rival)):
            until = [
                float(row["bumps_per_1000"])
                for row in side.evaluated("plus").rows
                if int(row["total_actions"]) <= each.actions
            ]
            assert value == until[-1]
    assert difference_at_equal_actions("plus-rmm", "plus-normm", "plus", [each]) is None


@pytest.mark.parametrize(("end", "theirs"), [(100, 10.0), (60, 20.0), (40, 30.0)])
def test_the_drives_of_a_predecessor_come_before(tmp_path: Path, end: int, theirs: float) -> None:
    def driven(name: str, *drives: tuple[int, float]) -> Experiment:
        (run,) = experiment(tmp_path, name).runs
        plain = run.evaluated("plus").rows[0]
        rows = tuple(
            plain | {"total_actions": str(actions), "bumps_per_1000": str(bumps)}
            for actions, bumps in drives
        )
        return Experiment((replace(run, evaluations=Rows(rows)),))

    rmm = driven("plus-rmm", (0, 50.0), (end, 9.0))
    before = driven("plus-normm", (0, 60.0), (40, 30.0))
    after = driven("plus-normm-fit", (41, 20.0), (90, 10.0), (150, 5.0))
    (found,) = at_equal_actions(rmm, after, {"plus-normm": before}, "plus")
    assert (found.seed, found.actions, found.ours, found.theirs) == (1, end, 9.0, theirs)


def test_policies_are_a_table_beside_the_thesis(tmp_path: Path) -> None:
    names = ("policy-eps-greedy", "policy-roulette")
    (section,) = compare_all([experiment(tmp_path, name, (1, 2)) for name in names])
    table = next(block for block in section.blocks if isinstance(block, Table))
    assert "Fig 4.2" in table.title
    assert [row[2] for row in table.rows] == ["38", "16"]
    assert "got farther than roulette alone, as in the thesis" in sentences(section)


@pytest.mark.parametrize(
    ("low", "mean", "high", "words"),
    [
        (-3.0, -2.0, -1.0, ["plus-rmm had fewer", "excludes 0", "so it is here"]),
        (1.0, 2.0, 3.0, ["plus-normm had fewer", "excludes 0", "here it is not"]),
        (-1.0, 0.5, 2.0, ["includes 0: undecided", "the thesis holds plus-rmm"]),
        (-1.0, 0.0, 1.0, ["equally many"]),
    ],
)
def test_a_difference_is_told_whichever_way_it_goes(
    low: float, mean: float, high: float, words: list[str]
) -> None:
    pair = Compared("plus-rmm", "plus-normm", "plus", (8, 8), Difference(mean, low, high))
    told = findings.difference(pair)
    for word in words:
        assert word in told
    few = findings.difference(replace(pair, seeds=(8, 3)))
    assert ("a hint only" in few) == pair.difference.sure
    assert "so it is here" not in few
    assert "here it is not" not in few


def test_what_was_kept_compares_the_drives_around_the_other_corridor(tmp_path: Path) -> None:
    before = experiment(tmp_path, "plus-rmm").runs[0]
    run = experiment(tmp_path, "plus-minus").runs[0]
    entry = kept(run, "plus", before)
    assert entry is not None
    drives = run.evaluated("plus")
    within = drives.numbers("episode") <= run.info.stages[0].last_episode
    assert entry.after == drives.numbers("mean_run")[within][-1]
    assert entry.before == before.evaluated("plus").numbers("mean_run")[-1]
    assert kept(run, "plus", None) is None  # it did not drive before its first episode
    assert kept(before, "plus", None) is None  # it never left


def test_numbers_are_written_with_three_digits() -> None:
    assert [number(x) for x in (1234.5, 12.345, 3.0, -0.5, float("nan"))] == [
        "1,234", "12.3", "3", "−0.5", "-",
    ]  # fmt: skip
    assert spread(np.array([3.0, 1.0, 2.0])) == "2 (1 to 3)"
    assert spread(np.array([])) == "-"


def test_images_shown_are_spread_over_the_set_in_order() -> None:
    assert chosen(3, 6) == [0, 1, 2]
    assert chosen(21, 6) == [0, 4, 8, 12, 16, 20]


def test_text_is_escaped() -> None:
    table = Table("<t>", ("a|b",), (("<script>",),))
    section = Section("s", "x & y", (table, Missing("<f>", "no data")))
    page = html("T", [section])
    assert "<script>" not in page
    assert "&lt;script&gt;" in page
    assert "a\\|b" in markdown([section], "figures")


def test_the_command_writes_pages_that_need_nothing_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("policy-eps-greedy", "policy-roulette"):
        write_run(tmp_path / "runs", name, 1)
    out = tmp_path / "out"
    assert main(["report", str(tmp_path / "runs"), "--out", str(out), "--gpu-step-ms", "3"]) == 0
    assert "report.html and 4 Markdown pages" in capsys.readouterr().out
    page = (out / "report.html").read_text()
    assert set(re.findall(r'(?:src|href)="([^"]{0,10})', page)) == {
        "data:image", "#runs", "#policy-ep", "#policy-ro", "#compariso",
    }  # fmt: skip
    for path in out.glob("*.md"):
        for picture in re.findall(r"\]\((figures/[^)]+)\)", path.read_text()):
            assert (out / picture).read_bytes().startswith(PNG)
    assert "projected hours" in (out / "runs.md").read_text()


def test_the_command_refuses_a_folder_without_a_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", str(tmp_path)]) == 2
    assert "expected the folder of a run" in capsys.readouterr().err
