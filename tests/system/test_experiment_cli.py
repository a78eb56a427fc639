"""`corridor experiment` as processes: seeds side by side, and how they are stopped."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.waiting import wait_until
from experiments.runs.schedule import shares_of

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

PLAN = ("experiment", "real-corridor", "--scale", "tenth", "--seeds", "2", "--jobs", "2")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_seeds_side_by_side_divide_the_cores_and_save_what_they_did(
    number: signal.Signals, tmp_path: Path
) -> None:
    command = [sys.executable, "-m", "services.cli", *PLAN, "--out", str(tmp_path)]
    runs = [tmp_path / "real-corridor-tenth" / f"seed-{seed}" for seed in (1, 2)]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        text=True,
        # As a shell does with what it starts in the background.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    ) as process:
        try:
            wait_until(
                lambda: all((run / "episodes.csv").exists() for run in runs), 90, "both runs begin"
            )
            process.send_signal(number)
            output, _ = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 1
    assert "the same command goes on" in output
    shares = shares_of(sorted(os.sched_getaffinity(0)), 2)
    for run, share in zip(runs, shares, strict=True):
        record = json.loads((run / "run.json").read_text())
        assert not record["complete"]
        assert record["fill_actions"] > 0
        assert record["machine"].endswith(f"{len(share)} cores")
        assert list(run.glob("state-*"))
        for role in ("actor", "replay", "learner"):  # one kept choice for all that have as much
            chosen = (run / "numerics" / f"{role}.json").read_text()
            kept = tmp_path.glob(f"machines/*/numerics/{role}.json")
            assert chosen in [path.read_text() for path in kept]
