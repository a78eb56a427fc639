"""`corridor emulate ros2` as a process, and its faults by command."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from services.cli import main as cli

pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    command = [sys.executable, "-m", "services.cli", "emulate", "ros2", "--preset", "turtlebot4"]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("CORRIDOR_")}
    with subprocess.Popen(
        [*command, "--listen", "tcp/127.0.0.1:0", "--fault", "bumper=stuck", "--tethered"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        line = process.stdout.readline().strip()
        assert line.startswith("tcp/127.0.0.1:"), line
        yield line
        process.stdin.close()
        assert process.wait(30) == 0


def faults(capsys: pytest.CaptureFixture[str], endpoint: str, *changes: str) -> dict[str, object]:
    assert cli.main(["emulate", "fault", *changes, "--endpoint", endpoint]) == 0
    told: dict[str, object] = json.loads(capsys.readouterr().out)
    return told


def test_faults_are_told_and_changed(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert faults(capsys, endpoint)["bumper"] == "stuck"
    told = faults(capsys, endpoint, "bumper=", "camera=frozen", "nobody_listens=true")
    assert (told["bumper"], told["camera"], told["nobody_listens"]) == ("", "frozen", True)


def refused(capsys: pytest.CaptureFixture[str], code: int, *arguments: str) -> str:
    assert cli.main(["emulate", *arguments]) == code
    output = capsys.readouterr()
    assert output.err.startswith("corridor: ")
    assert output.err.count("\n") == 1
    return output.err


def test_faults_that_there_are_not_are_refused_in_one_line(
    endpoint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    place = ("--endpoint", endpoint)
    assert "camera" in refused(capsys, 2, "fault", "camera=blind", *place)
    assert "expected NAME=VALUE" in refused(capsys, 2, "fault", "camera", *place)
    assert "colour" in refused(capsys, 2, "fault", "colour=red", *place)
    assert "camera" in refused(capsys, 2, "ros2", "--fault", "camera=blind")


def test_places_that_cannot_be_are_refused_in_one_line(
    endpoint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "no Zenoh router" in refused(capsys, 1, "fault", "--endpoint", "tcp/127.0.0.1:1")
    assert "cannot listen" in refused(capsys, 2, "ros2", "--listen", endpoint)
    assert "nowhere" in refused(capsys, 2, "ros2", "--world", "nowhere")
    transport = refused(capsys, 2, "ros2", "--transport", "mqtt")
    assert "robot.ros2.transport" in transport
