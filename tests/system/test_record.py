"""A run recorded by its own process, and played back: the actor chooses the same again (H8)."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from cluster import ALL, Cluster, make_config

from services.recorder.reader import Recording

pytestmark = [pytest.mark.system, pytest.mark.timeout(600)]
DEADLINE_S = 300.0


def record(cluster: Cluster, out: Path) -> subprocess.Popen[str]:
    place = ["--run-dir", str(cluster.folder), "--endpoint", cluster.config.bus.endpoint]
    file = ["--config", str(cluster.folder.parent / f"{cluster.folder.name}.toml")]
    process = subprocess.Popen(
        [sys.executable, "-m", "services.cli", "record", "--out", str(out), *place, *file],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    cluster.wait(lambda: recorded(out) >= 0, DEADLINE_S, "the recorder writes")
    return process


def recorded(path: Path) -> int:
    """How many versions of the weights a recording has; -1 before it begins."""
    return len(Recording(path).weights) if path.exists() and path.stat().st_size else -1


def playback(path: Path) -> tuple[int, str]:
    command = [sys.executable, "-m", "services.cli", "playback", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE_S)
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize("ending", ["clean", "killed"])
def test_a_recorded_run_gives_its_actions_again(ending: str, run_name: str, tmp_path: Path) -> None:
    config = make_config(run_name)
    out = tmp_path / "drive.mcap"
    with Cluster(config, tmp_path / "run") as cluster:
        cluster.start(*ALL[:-1])
        with record(cluster, out) as process:
            cluster.start("driver")
            cluster.wait_episodes(6, DEADLINE_S)
            if ending == "killed":
                cluster.wait(lambda: recorded(out) >= 5, DEADLINE_S, "weights on disk")
                process.kill()
                process.communicate(timeout=DEADLINE_S)
            else:
                process.send_signal(2)
                said, _ = process.communicate(timeout=DEADLINE_S)
                assert process.returncode == 0, said
                assert "(0 lost)" in said
        cluster.stop_all()
    recording = Recording(out)
    assert recording.complete == (ending == "clean")
    assert recording.origin.config.fingerprint() == config.fingerprint()
    code, said = playback(out)
    assert code == 0, said
    found = re.search(r"(\d+) of (\d+) actions equal, (\d+) of them to the last bit", said)
    assert found, said
    equal, total, exact = map(int, found.groups())
    assert equal == total == exact
    assert equal > 300, said  # the memory holds 400, filled before the first episode
