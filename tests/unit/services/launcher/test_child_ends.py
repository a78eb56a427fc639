"""What follows after the end of a child, by its exit code."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from services.launcher.supervisor import ChildSpec, Ending, Supervisor


@pytest.mark.parametrize(
    ("code", "may_finish", "ending", "state"),
    [
        (0, True, Ending(0, "all services have stopped"), "stopped"),
        (0, False, None, "restarting"),
        (1, True, None, "restarting"),
        (2, True, Ending(2, "child: exit 2"), "restarting"),
        (3, True, Ending(3, "child: exit 3"), "restarting"),
    ],
)
def test_only_what_would_come_again_ends_everything(
    code: int, may_finish: bool, ending: Ending | None, state: str, tmp_path: Path
) -> None:
    command = (sys.executable, "-c", f"raise SystemExit({code})")
    with Supervisor([ChildSpec("child", command, 0, may_finish)], tmp_path, os.environ) as children:
        os.waitid(os.P_PID, children.pids()["child"], os.WEXITED | os.WNOWAIT)
        assert children.poll() == ending
        (status,) = children.statuses()
        assert status.state == state
