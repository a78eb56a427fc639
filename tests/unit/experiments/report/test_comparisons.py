"""Comparisons of experiments: what plans tell, drawn where the runs are and named where not."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from experiments import report
from experiments.plans.plan import plan_names, presentations, read_plan
from experiments.report.comparisons import compare_all
from experiments.report.document import Missing, Section, Table
from experiments.report.figures.style import PALETTE
from experiments.report.full_report import all_sections
from experiments.report.run_folder import Experiment, load
from shared.errors import ConfigError
from tests.synthetic_runs import experiment, missing, sentences, titles, write_probes, write_run


def compared(shown: Sequence[Experiment]) -> list[Section]:
    return compare_all(shown, presentations(each.name for each in shown))


def test_memories_that_did_not_begin_equal_are_told(tmp_path: Path) -> None:
    for name, fill in (("policy-roulette", "a"), ("policy-eps-greedy", "b")):
        write_run(tmp_path, name, 1, prefill="same")
        write_run(tmp_path, name, 2, prefill=fill)
    (section,) = compared(load([tmp_path]))
    assert "In seed 2 the memories were not equal at the beginning." in sentences(section)


def test_another_method_is_compared_at_its_scale(tmp_path: Path) -> None:
    for seed in (1, 2):
        write_run(tmp_path, "plus-rmm", seed)
        other = write_run(tmp_path / "other", "policy-roulette", seed)
        (other / "episodes.csv").unlink()
        info = json.loads((other / "run.json").read_text())
        left = {key: info[key] for key in info if key not in ("after", "prefill", "first_lap")}
        left |= {"experiment": "dqn-distance", "actions": 5000}
        (other / "run.json").write_text(json.dumps(left))
    found = load([tmp_path / "other", tmp_path / "plus-rmm-tenth"])
    (section,) = compared(found)
    assert section.name == "comparisons-tenth"
    assert "In plus, dqn-distance bumps " in sentences(section)
    assert found[0].runs[0].actions == 5000  # there are no episodes to add up


def test_comparisons_are_drawn_when_all_their_experiments_are_there(tmp_path: Path) -> None:
    names = ("plus-normm", "plus-normm-fit", "plus-rmm", "plus-rmm-nopretrain", "plus-minus")
    all_of = [experiment(tmp_path, name, (1, 2)) for name in names]
    (section,) = compared(all_of)
    shown = "\n".join(titles(section))
    for figure in ("Fig 4.5", "Fig 4.12", "Fig 4.10", "Fig 4.16", "newest frozen drives"):
        assert figure in shown
    assert missing(section) == []
    assert "In plus, plus-normm bumps " in sentences(section)
    kept_table = next(b for b in section.blocks if isinstance(b, Table) and "Kept" in b.title)
    assert [row[0] for row in kept_table.rows] == ["1", "2"]


def test_comparisons_without_an_experiment_say_which(tmp_path: Path) -> None:
    some = [experiment(tmp_path, name) for name in ("plus-normm", "plus-normm-fit", "plus-rmm")]
    (section,) = compared(some)
    why = {block.what: block.why for block in section.blocks if isinstance(block, Missing)}
    what = "Fitness of plus-rmm, plus-rmm-nopretrain, plus-normm-fit (Fig 4.12)"
    assert why[what] == "no runs of plus-rmm-nopretrain at this scale were given"
    newest = "Bumps of the newest frozen drives, seed by seed"
    assert why[newest] == "fewer than two seeds of both were run"
    (section,) = compared(some[1:])
    why = {block.what: block.why for block in section.blocks if isinstance(block, Missing)}
    what = "Fitness of plus-normm, and of plus-normm-fit, which continues it (Fig 4.5)"
    assert "no runs of plus-normm at" in why[what]
    (section,) = compared([some[0], some[2]])
    assert "Predicted rewards in plus, plus-rmm and plus-normm (Fig 4.10)" in titles(section)


def test_networks_asked_about_different_images_are_not_compared(tmp_path: Path) -> None:
    write_run(tmp_path, "plus-normm", 1)
    other = write_run(tmp_path, "plus-rmm", 1)
    write_probes(other / "probes-best-plus.npz", "plus", np.random.default_rng(1), count=7)
    (section,) = compared(load([tmp_path]))
    assert any("different images" in b.why for b in section.blocks if isinstance(b, Missing))


def test_one_experiment_is_not_compared(tmp_path: Path) -> None:
    assert compared([experiment(tmp_path, "i16c")]) == []


def test_more_experiments_than_colours_share_no_figure(tmp_path: Path) -> None:
    for count in (len(PALETTE), len(PALETTE) + 1):
        folder = tmp_path / str(count)
        for variant in range(count):
            for seed in (1, 2):
                write_run(folder, f"variant-{variant}", seed)
        (section,) = compared(load([folder]))
        shared = [title for title in titles(section) if title.startswith("Frozen evaluation")]
        left_out = [what for what in missing(section) if what.startswith("frozen evaluation of")]
        assert (len(shared), len(left_out)) == ((1, 0) if count == len(PALETTE) else (0, 1))
        assert "Bumps of the newest frozen drives, seed by seed" in titles(section)


def test_variants_are_compared_with_what_they_vary(tmp_path: Path) -> None:
    names = ("search-fast", "search-demo", "search-normm", "plus-rmm-quotas", "plus-rmm-nopretrain")
    (section,) = compared([experiment(tmp_path, name, (1, 2)) for name in names])
    tables = [block for block in section.blocks if isinstance(block, Table)]
    compared_pairs = {row[0] for t in tables if "newest" in t.title for row in t.rows}
    assert compared_pairs == {
        "plus-rmm-nopretrain / plus-rmm-quotas",
        "search-demo / search-fast",
        "search-demo / search-normm",
    }


def test_policies_are_a_table_beside_the_thesis(tmp_path: Path) -> None:
    names = ("policy-eps-greedy", "policy-roulette")
    (section,) = compared([experiment(tmp_path, name, (1, 2)) for name in names])
    table = next(block for block in section.blocks if isinstance(block, Table))
    assert "Fig 4.2" in table.title
    assert [row[2] for row in table.rows] == ["38", "16"]


PLAN = """
title = "{title}"
source = "not in the thesis"
[config.memory]
capacity = 1000
[[stages]]
name = "learn"
until = 100
[report]
groups = ["new-group"]
{report}
"""


def test_a_plan_of_ones_own_is_compared_without_code(tmp_path: Path) -> None:
    plans = tmp_path / "plans"
    plans.mkdir()
    (plans / "one.toml").write_text(
        PLAN.format(
            title="One",
            report="""
            reference_of = ["new-group"]
            table = "fitness"
            figures = { table = "Fig 9.1", fitness = "Fig 9.2" }
            [[report.comparisons]]
            kind = "equal-actions"
            others = ["two"]
            [[report.comparisons]]
            kind = "predictions"
            others = ["two"]
            figure = "Fig 9.3"
            """,
        )
    )
    for name in ("two", "three"):
        (plans / f"{name}.toml").write_text(PLAN.format(title=name, report='table = "fitness"'))
    shown = [experiment(tmp_path / "runs", name, (1, 2)) for name in ("one", "two", "three")]
    _, section, first, *_ = all_sections(shown, plans=plans)
    assert "Frozen evaluation in plus, one, two, three" in titles(section)
    assert "Predicted rewards in plus, one and two (Fig 9.3)" in titles(section)
    assert "Fitness (Fig 9.2)" in titles(first)
    assert first.name == "one-tenth"
    tables = [block.title for block in section.blocks if isinstance(block, Table)]
    assert tables[0].endswith("(Fig 9.1)")
    assert "Bumps of one after as many actions of learning" in tables
    pairs = [row[0] for block in section.blocks if isinstance(block, Table) for row in block.rows]
    assert "one / two" in pairs
    assert "two / three" not in pairs  # all are compared with the reference only


@pytest.mark.parametrize(
    "report", ["table = 'unknown'", "[[report.comparisons]]\nkind = 'continued'\nothers = []"]
)
def test_a_plan_that_asks_for_what_there_is_not_is_refused(report: str) -> None:
    with pytest.raises(ConfigError, match=r"plan mine: report\."):
        read_plan("mine", PLAN.format(title="Mine", report=report))


def test_no_code_of_reports_names_an_experiment() -> None:
    names = "|".join(re.escape(name) for name in plan_names() if name not in ("demo", "i16c"))
    for path in Path(report.__path__[0]).rglob("*.py"):
        assert not re.search(rf"""["'](?:{names})["']""", path.read_text()), path
