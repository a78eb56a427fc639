"""A run recorded by its own process, and played back: the actor chooses the same again (H8)."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from cluster import ALL, Cluster, make_config

from services.recorder.reader import Recording

pytestmark = [pytest.mark.system, pytest.mark.timeout(600)]
DEADLINE_S = 300.0


def record(cluster: Cluster, out: Path, *more: str) -> subprocess.Popen[str]:
    place = ["--run-dir", str(cluster.folder), "--endpoint", cluster.config.bus.endpoint]
    file = ["--config", str(cluster.folder.parent / f"{cluster.folder.name}.toml")]
    return subprocess.Popen(
        [sys.executable, "-m", "services.cli", "record", "--out", str(out), *place, *file, *more],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


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
            cluster.wait(lambda: recorded(out) >= 0, DEADLINE_S, "the recorder writes")
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
                keep_the_last_seconds(cluster, tmp_path)
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


def keep_the_last_seconds(cluster: Cluster, folder: Path) -> None:
    """A signal writes what was kept, and so does the end; both play back."""
    with record(cluster, folder / "last.mcap", "--last", "600") as process:
        assert process.stdout is not None
        assert any("kill -USR1" in line for line in process.stdout)
        learner = cluster.learner()
        assert learner is not None
        cluster.wait_episodes(learner.episode + 3, DEADLINE_S)
        process.send_signal(signal.SIGUSR1)
        cluster.wait(lambda: (folder / "last-1.mcap").exists(), DEADLINE_S, "the signal writes")
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=DEADLINE_S)
    messages = []
    for number in (1, 2):
        code, said = playback(folder / f"last-{number}.mcap")
        assert code == 0, said
        messages.append(Recording(folder / f"last-{number}.mcap").summary["messages"])
    assert 0 < messages[0] <= messages[1]
