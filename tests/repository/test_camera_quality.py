"""The camera's quality for learning: what drives count, what is kept, what short mode skips."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks import camera_quality, run_all
from benchmarks.camera_quality import CHECK

TINY = replace(CHECK, seeds=(1,), actions=20, starts=1, drive_actions=60)


def test_last_line_of_the_script_is_its_bar(capsys: pytest.CaptureFixture[str]) -> None:
    camera_quality.main(["--check"])
    bars = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert [bar["id"] for bar in bars] == ["P6c"]
    assert bars[0]["n"] == len(CHECK.seeds)
    assert (bars[0]["better"], bars[0]["required"], bars[0]["aim"]) == ("lower", 1.25, 1.0)
    parts = ("bumps_per_1000", "least", "most", "distance", "laps", "nowhere")
    names = {f"{part}_{width}" for part in parts for width in (75, 150)}
    assert bars[0]["checks"].keys() == names | {"bumps_per_1000_random"}


def test_stored_runs_are_not_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[tuple[int, int]] = []

    def learnt(plan: Any, seed: int, width: int, folder: Path) -> Any:
        made.append((seed, width))
        run = {"settings": camera_quality.settings_of(plan, seed, width), "seconds": 1.0}
        run |= {"driving": {"bumps": len(made)}, "learning": {}}
        camera_quality.store(run, folder)
        return run

    monkeypatch.setattr(camera_quality, "learnt", learnt)
    first = camera_quality.all_runs(TINY, tmp_path, 1)
    assert made == [(1, 75), (1, 150)]
    next(tmp_path.glob("quality-150-*")).unlink()
    again = camera_quality.all_runs(TINY, tmp_path, 1)
    assert made == [(1, 75), (1, 150), (1, 150)]
    assert again[0] == first[0]
    camera_quality.all_runs(replace(TINY, actions=21), tmp_path, 1)
    assert len(made) == 5, "other settings are other runs"


def test_a_run_is_stored_as_it_is(tmp_path: Path) -> None:
    run = camera_quality.learnt(TINY, 1, 75, tmp_path)
    assert camera_quality.stored(run["settings"], tmp_path) == json.loads(json.dumps(run))
    assert run["learning"]["actions"] >= TINY.actions
    assert run["driving"]["actions"] == TINY.drive_actions


def made_up_run(width: int, bumps: int, distance: float = 0.5) -> dict[str, Any]:
    driven = {
        "actions": 1000, "bumps": bumps, "bumps_per_1000": float(bumps),
        "distance": distance, "laps_left": 1, "laps_right": 2,
    }  # fmt: skip
    return {"settings": {"width": width}, "driving": driven}


RANDOM = {"bumps_per_1000": 80.0, "distance": 0.3}


@pytest.mark.parametrize(("bumps", "ratio"), [((0, 0, 0, 0), 1.0), ((3, 0, 0, 0), 3.0)])
def test_no_bumps_at_all_still_give_a_ratio(bumps: tuple[int, ...], ratio: float) -> None:
    runs = [made_up_run(*each) for each in zip((75, 75, 150, 150), bumps, strict=True)]
    assert camera_quality.bar(runs, RANDOM).value == pytest.approx(ratio)


def test_runs_that_only_circle_are_told_apart() -> None:
    runs = [made_up_run(75, 4, 0.12), made_up_run(75, 4), made_up_run(150, 4)]
    checks = camera_quality.bar(runs, RANDOM).checks
    assert (checks["nowhere_75"], checks["nowhere_150"]) == (1, 0)


def test_short_measuring_leaves_long_scripts_out_and_keeps_what_they_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = {"command": "python -m benchmarks.camera_quality", "bars": [], "error": ""}
    results = tmp_path / "results.json"
    results.write_text(json.dumps({"camera_quality": kept}))
    monkeypatch.setattr(run_all, "RESULTS", results)
    ran: list[str] = []
    written: list[dict[str, Any]] = []
    monkeypatch.setattr(
        run_all, "run", lambda name, *, short: ran.append(name) or {"bars": [], "error": ""}
    )
    monkeypatch.setattr(run_all, "write", written.append)
    assert run_all.main(["--short"]) == 0
    assert "camera_quality" not in ran
    assert "simulator" in ran
    assert written[-1]["camera_quality"] == kept
    assert run_all.main(["--short", "camera_quality"]) == 0
    assert "camera_quality" not in ran
    assert run_all.main(["camera_quality"]) == 0
    assert ran[-1] == "camera_quality"
