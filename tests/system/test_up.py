"""`corridor up` with the real services, a narrow network and a small memory."""

from __future__ import annotations

import csv
import json
import os
import re
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from benchmarks.terminals import Terminal
from benchmarks.waiting import wait_until
from experiments.report.run_folder import read_run

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

CORRIDOR = [sys.executable, "-m", "services.cli"]
SMALL = (
    "network.filters=8", "memory.capacity=200", "memory.equalise_every=3",
    "learning.batch_size=8", "learning.fit_every=3", "learning.fit_epochs=1",
)  # fmt: skip
ENVIRONMENT = {k: v for k, v in os.environ.items() if not k.startswith("CORRIDOR_")}


def command(folder: Path, *options: str) -> list[str]:
    sets = [f"--set={item}" for item in SMALL]
    return [*CORRIDOR, "up", "--run-dir", str(folder), *sets, *options]


def start(folder: Path, *options: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        command(folder, *options),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ENVIRONMENT,
    )


def finish(process: subprocess.Popen[str], timeout_s: float) -> str:
    """Wait for the end and return the output; whatever happens, nothing is left."""
    try:
        output, errors = process.communicate(timeout=timeout_s)
    finally:
        process.kill()
    assert process.returncode == 0, output + errors
    return output


def corridor(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*CORRIDOR, *arguments], capture_output=True, text=True, env=ENVIRONMENT, check=False
    )


def episode_numbers(folder: Path) -> list[int]:
    with (folder / "episodes.csv").open() as stream:
        return [int(row["episode"]) for row in csv.DictReader(stream)]


def test_a_run_ends_by_itself_and_is_continued_by_the_same_command(tmp_path: Path) -> None:
    output = finish(start(tmp_path, "--episodes", "4"), 90)
    assert output.startswith("corridor: starting\n")
    assert "4 episodes are done" in output
    first = episode_numbers(tmp_path)
    assert first[:4] == [1, 2, 3, 4]
    assert "8 episodes are done" in finish(start(tmp_path, "--episodes", "8"), 90)
    assert episode_numbers(tmp_path) == list(range(1, len(episode_numbers(tmp_path)) + 1))
    assert len(episode_numbers(tmp_path)) >= 8
    for name in ("config.toml", "run.json", "training.csv", "logs", "tensorboard"):
        assert (tmp_path / name).exists(), name
    run = read_run(tmp_path)
    assert (run.info.scale, run.info.actions) == ("services", run.actions)
    assert run.train_steps > 0 < run.info.seconds
    diagnosed = corridor("diagnose", str(tmp_path))
    assert diagnosed.stdout.endswith("not up\nnothing found\n"), diagnosed
    reported = corridor("report", str(tmp_path), "--out", str(tmp_path / "report"))
    assert reported.returncode == 0, reported.stderr
    assert "Run of the services" in (tmp_path / "report" / "report.html").read_text()
    quick = ("--starts", "1", "--actions", "50", "--out", str(tmp_path / "evaluated"))
    evaluated = corridor("evaluate", str(tmp_path), *quick)
    assert evaluated.returncode == 0, evaluated.stderr
    other = corridor("up", "--run-dir", str(tmp_path), "--set", "network.filters=16")
    assert other.returncode == 2
    assert "network.filters is 8 there, but 16 now" in other.stderr


def test_a_running_run_is_found_watched_commanded_and_stopped(tmp_path: Path) -> None:
    process = start(tmp_path)
    try:
        where = ("--run-dir", str(tmp_path))
        wanted = ("driver", "actor", "replay", "learner")
        require = [word for name in wanted for word in ("--require", name)]

        def alive() -> bool:
            return corridor("status", *where, *require).returncode == 0

        wait_until(alive, 40, "all services to answer")
        assert re.match(
            r"robotino1 \(life [0-9a-f]{12}\): estop, stands\n$", corridor("estop", *where).stdout
        )
        state = json.loads(corridor("status", *where, "--json").stdout)
        assert state["robots"]["robotino1"]["state"] == "estop"
        assert {service["service"] for service in state["services"]} == set(wanted)
        assert "robot stands: robotino1: estop" in corridor("diagnose", str(tmp_path)).stdout
        assert corridor("clear", *where).returncode == 0
        watched = corridor("streams", "echo", "observation", "--seconds", "1", *where)
        assert watched.stdout.startswith('robotino1 {"robot": "robotino1", '), watched
        stopped = corridor("stop", *where)
        assert stopped.returncode == 0, stopped.stdout
        assert "all services have stopped" in finish(process, 20)
    finally:
        process.kill()


def test_killed_services_are_restarted_and_the_run_goes_on(tmp_path: Path) -> None:
    process = start(tmp_path)
    try:
        wait_until((tmp_path / "episodes.csv").exists, 40, "metrics")
        address = (tmp_path / "page").read_text()
        for name in ("replay", "router", "actor", "page"):
            os.kill(started(tmp_path, name)[-1], signal.SIGKILL)
            wait_until(partial(was_restarted, tmp_path, name), 20, f"{name} again")
        before = len(episode_numbers(tmp_path))
        wait_until(lambda: len(episode_numbers(tmp_path)) >= before + 2, 60, "two more episodes")
        process.send_signal(signal.SIGINT)
        assert f"page {address.strip()} | " in (said := finish(process, 20))
        assert "all stopped" in said
        assert (tmp_path / "page").read_text() == address  # a browser finds it again
        numbers = episode_numbers(tmp_path)
        assert numbers == list(range(1, len(numbers) + 1))
    finally:
        process.kill()


def test_a_frozen_driver_is_killed_and_the_run_goes_on(tmp_path: Path) -> None:
    process = start(tmp_path, "--set=bus.hang_s=6.0")
    try:
        wait_until((tmp_path / "episodes.csv").exists, 60, "metrics")
        wait_until(lambda: episode_numbers(tmp_path), 60, "an episode")
        os.kill(started(tmp_path, "driver")[-1], signal.SIGSTOP)
        wait_until(partial(was_restarted, tmp_path, "driver"), 60, "driver again")
        assert "driver: no heartbeat for " in (tmp_path / "logs" / "up.log").read_text()
        before = len(episode_numbers(tmp_path))
        wait_until(lambda: len(episode_numbers(tmp_path)) >= before + 2, 60, "two more episodes")
        process.send_signal(signal.SIGINT)
        output = finish(process, 20)
        assert "driver was restarted once, last after no heartbeat for " in output
    finally:
        process.kill()


def test_the_space_key_stops_the_robot_and_ctrl_c_the_run(tmp_path: Path) -> None:
    with Terminal(command(tmp_path), env={**ENVIRONMENT, "TERM": "xterm"}) as person:
        wait_until(lambda: "robot robotino1" in person.shown(), 60, "the robot is there")
        assert not person.gives_lines()
        person.press(b" ")
        wait_until(lambda: "all stand" in person.shown(), 20, "what was done")
        assert "estop, stands" in person.shown()
        assert (tmp_path / "halts" / "driver-robotino1.msgpack").exists()
        person.press(b"\x03")
        assert wait_until(lambda: "all stopped" in person.shown(), 20, "the end")
        assert person.process.wait(20) == 0
        assert person.gives_lines()


def started(folder: Path, name: str) -> list[int]:
    """Process ids that one child of the run has had so far."""
    rows = (folder / "logs" / "up.log").read_text().splitlines()
    return [int(row.rsplit(" ", 1)[1]) for row in rows if f" {name} started as process " in row]


def was_restarted(folder: Path, name: str) -> bool:
    return len(started(folder, name)) == 2
