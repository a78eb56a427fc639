"""Benchmarks run, say what they must on their last line, and end up in the tables."""

from __future__ import annotations

import importlib
import json
from typing import Any

import pytest

from benchmarks import frame, frames, run_all
from benchmarks.frame import Bar
from shared import provenance

FIELDS = {
    "id", "value", "unit", "better", "required", "aim", "baseline_median", "ours_median", "n",
}  # fmt: skip
SCRIPTS = {
    "training_step": ["P1"],
    "choose_action": ["P2a", "P2b", "P2c"],
    "bulk_pass": ["P3a", "P3b", "P3c"],
    "candidate_search": ["P4a", "P4b", "P4c", "P4d"],
    "gpu": ["P9a", "P9b", "P9c", "P9d"],
    "growth": ["P11a", "P11b"],
}


def make_bar(**given: Any) -> Bar:
    fields = {
        "id": "P0", "value": 4.5, "unit": "x", "better": "higher", "required": 4.0, "aim": 6.0,
        "baseline_median": 9.0, "ours_median": 2.0, "n": 3,
    }  # fmt: skip
    return Bar(**{**fields, **given})


@pytest.mark.parametrize("name", SCRIPTS)
def test_last_line_of_a_script_is_its_bars(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    importlib.import_module(f"benchmarks.{name}").main(["--check"])
    bars = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert [bar["id"] for bar in bars] == SCRIPTS[name]
    for bar in bars:
        assert bar.keys() - {"checks"} == FIELDS
        assert bar["better"] in ("higher", "lower")
        assert bar["n"] >= 1
        assert frame.as_json(frame.from_json(bar)) == bar


def test_scripts_are_found_in_the_order_of_their_bars() -> None:
    found = run_all.scripts()
    assert [name for name in found if name in SCRIPTS] == list(SCRIPTS)
    assert not {"frame", "frames", "plain", "run_all"} & set(found)


@pytest.mark.parametrize(
    ("arguments", "mode"), [([], "full"), (["--short"], "short"), (["--check"], "check")]
)
def test_modes(arguments: list[str], mode: str) -> None:
    assert frame.mode_of(arguments, "") == mode


@pytest.mark.parametrize(
    ("better", "value", "verdict"),
    [
        ("higher", 6.0, "aim met"), ("higher", 5.9, "met"), ("higher", 4.0, "met"),
        ("higher", 3.9, "short"), ("lower", 6.0, "short"), ("lower", 4.0, "aim met"),
    ],
)  # fmt: skip
def test_verdicts(better: Any, value: float, verdict: str) -> None:
    aim = 6.0 if better == "higher" else 4.0
    assert make_bar(better=better, value=value, aim=aim).verdict == verdict


def test_cases_take_turns_and_the_warm_up_does_not_count() -> None:
    calls: list[str] = []
    cases = {name: lambda name=name: calls.append(name) for name in "ab"}
    times = frame.interleaved(cases, rounds=2, warm_up=1)
    assert "".join(calls) == "ababab"
    assert [len(spent) for spent in times.values()] == [2, 2]


def test_a_speedup_is_the_ratio_of_medians() -> None:
    bar = frame.speedup("P0", [0.1, 0.4, 9.0], [0.1, 0.1, 0.2], required=4.0, aim=6.0)
    assert bar.value == pytest.approx(4.0)
    assert (bar.baseline_median, bar.ours_median) == pytest.approx((400.0, 100.0))
    assert bar.n == 3


def test_results_become_tables_between_the_marks_of_a_page() -> None:
    entry = {
        "command": "python -m benchmarks.training_step", "mode": "full", "when": "now",
        "seconds": 1.0, "error": "", "machine": provenance.machine(),
        "bars": [frame.as_json(make_bar(checks={"cosine": 0.9999}))],
    }  # fmt: skip
    failed = {**entry, "bars": [], "error": "exit code 1"}
    text = run_all.rendered({"training_step": entry, "bulk_pass": failed})
    assert "| P0 | 4.5   | x    | 4        | 6   | met" in text
    assert "cosine 0.9999" in text
    assert "exit code 1" in text
    page = "before\n<!-- measured -->\n\nold\n\n<!-- end -->\nafter\n"
    new = run_all.renewed(page, text)
    assert new == f"before\n<!-- measured -->\n\n{text}\n\n<!-- end -->\nafter\n"
    assert run_all.renewed(new, text) == new


def test_frames_are_real_and_differ() -> None:
    store = frames.samples("check")
    images = frames.images("check", len(store))
    assert len(store) == frames.SIZES["check"].frames
    assert len({image.tobytes() for image in images}) > len(store) // 2
    assert set(store.rows["action"]) == {0, 1, 2}
