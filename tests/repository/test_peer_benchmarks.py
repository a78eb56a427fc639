"""Comparisons with other projects: fair where it can be checked, silent where they are missing."""

from __future__ import annotations

import importlib
import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import peer_learning, peer_transport, peers, run_all
from shared.provenance import ROOT

SCRIPTS = ("peer_learning", "peer_replay", "peer_transport")
CHUNK = peer_transport.CHUNK_BYTES
KEPT = {"command": "python -m benchmarks.peer_replay", "bars": [], "error": ""}


# ---------------------------------------------------------------- work of our side


def test_ours_trains_a_mini_batch_every_four_steps_after_the_random_ones() -> None:
    ours = peer_learning.Ours(peer_learning.configuration("check"), random_steps=60)
    ours.drive(60)
    assert ours.trainer.train_steps == 0
    ours.drive(16)
    assert ours.trainer.train_steps == 4
    ours.close()


@pytest.mark.parametrize("size", [1, CHUNK - 1, CHUNK, CHUNK + 1, 5 * CHUNK // 2])
def test_weights_come_out_of_chunks_as_they_went_in(size: int) -> None:
    data = np.random.default_rng(size).bytes(size)
    cut = list(peer_transport.chunks(data))
    assert max(map(len, cut)) <= CHUNK + 1
    assert peer_transport.joined(iter(cut)) == data
    with pytest.raises(EOFError):
        peer_transport.joined(iter(cut[:-1]))


# ---------------------------------------------------------------- peers that are missing


def test_peers_come_last_of_the_comparisons() -> None:
    found = run_all.scripts()
    assert [name for name in found if name in SCRIPTS] == list(SCRIPTS)
    assert not {"peers", "peer_dqn", "peer_torchrl"} & set(found)


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_missing_peer_is_said_in_one_line(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = importlib.import_module(f"benchmarks.{name}")
    monkeypatch.setattr(importlib.util, "find_spec", lambda module: None)
    with pytest.raises(SystemExit) as ended:
        script.main(["--check"])
    assert ended.value.code == peers.NOT_INSTALLED
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 1
    assert said[0].startswith(f"{name}: not measured, ")
    assert said[0].endswith("make bench-peers")


def test_what_is_installed_is_no_reason_to_stop() -> None:
    peers.require(__file__, "numpy", "json")


def test_stored_results_of_missing_peers_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = tmp_path / "results.json"
    results.write_text(json.dumps({"peer_replay": KEPT}))
    before = results.read_text()
    monkeypatch.setattr(run_all, "RESULTS", results)
    monkeypatch.setattr(run_all, "PAGE", tmp_path / "none.md")
    command = [sys.executable, "-c", f"import sys; print('no'); sys.exit({peers.NOT_INSTALLED})"]
    real = subprocess.Popen
    monkeypatch.setattr(
        subprocess, "Popen", lambda words, **given: real(command, **{**given, "cwd": ROOT})
    )
    assert run_all.run("peer_replay", short=True) is None
    assert run_all.main(["peer_replay", "peer_learning"]) == 0
    assert results.read_text() == before


def test_peers_stand_in_one_file_with_exact_versions_that_fit_the_constraints() -> None:
    def pins(path: str) -> dict[str, str]:
        lines = (ROOT / path).read_text().splitlines()
        return dict(line.split("==") for line in lines if line and not line.startswith("#"))

    ours, theirs = pins("constraints.txt"), pins("benchmarks/requirements-peers.txt")
    assert {"stable_baselines3", "torchrl", "tensordict", "grpcio"} <= theirs.keys()
    assert "torch" not in theirs
    both = ours.keys() & theirs.keys()
    assert {name: ours[name] for name in both} == {name: theirs[name] for name in both}
