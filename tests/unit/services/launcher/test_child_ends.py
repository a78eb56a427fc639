"""What follows after the end of a child, by its exit code."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from benchmarks.waiting import wait_until
from services.launcher.supervisor import ChildSpec, Ending, Supervisor


@pytest.mark.parametrize(
    ("code", "may_finish", "vital", "ending", "state"),
    [
        (0, True, True, Ending(0, "all services have stopped"), "stopped"),
        (0, False, True, None, "restarting"),
        (1, True, True, None, "restarting"),
        (2, True, True, Ending(2, "child: exit 2"), "restarting"),
        (3, True, True, Ending(3, "child: exit 3"), "restarting"),
        (2, False, False, None, "restarting"),
    ],
)
def test_only_what_would_come_again_ends_everything(
    code: int, may_finish: bool, vital: bool, ending: Ending | None, state: str, tmp_path: Path
) -> None:
    command = (sys.executable, "-c", f"raise SystemExit({code})")
    spec = ChildSpec("child", command, 0, may_finish, vital)
    with Supervisor([spec], tmp_path, os.environ) as children:
        os.waitid(os.P_PID, children.pids()["child"], os.WEXITED | os.WNOWAIT)
        assert children.poll() == ending
        (status,) = children.statuses()
        assert status.state == state


def test_the_output_of_a_child_does_not_grow_without_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.launcher.supervisor.MOST_OUTPUT_BYTES", 1000)
    source = (
        "import os\nos.write(1, b'x' * 2000)\ninput()\nos.write(1, b'the end')\nraise SystemExit(1)"
    )
    spec = ChildSpec("child", (sys.executable, "-c", source), 0)
    with Supervisor([spec], tmp_path, os.environ) as children:
        output = tmp_path / "child.out"
        wait_until(lambda: output.stat().st_size == 2000, 20, "output")
        children.poll()
        assert output.stat().st_size == 0
        assert (tmp_path / "child.out.1").stat().st_size == 2000
        process = children._children[0].process
        assert process is not None
        assert process.stdin is not None
        process.stdin.write(b"\n")
        process.stdin.close()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        assert children.poll() is None
        assert children.statuses()[0].note == "exit code 1: the end"
