"""`corridor status` in a narrow window, and with texts of strangers."""

from __future__ import annotations

import io

import pytest
from fakes import message
from rich.console import Console

from services.monitor.heartbeats import Seen, Snapshot
from services.monitor.status import WIDE, Entry, report
from shared.config import Config
from shared.keys import Peer
from shared.messages import Fault, RobotState, ServiceReply

LIFE = "a" * 12
ENTRIES = [
    Entry(Peer(name, ident, LIFE, "2", "f" * 16), message(ServiceReply, pid=12345, uptime_s=125.0))
    for name, ident in (("driver", "robotino1"), ("replay", "main"))
]


def shown(width: int, snapshot: Snapshot) -> str:
    console = Console(file=io.StringIO(), width=width, markup=False, emoji=False)
    with console.capture() as capture:
        console.print(report(Config(), ENTRIES, snapshot, narrow=width < WIDE))
    return capture.get()


@pytest.mark.parametrize("width", [40, WIDE, 200])
def test_who_is_there_fits_into_every_window(width: int) -> None:
    text = shown(width, Snapshot())
    assert all(word in text for word in ("robotino1", "replay", "12345", "0:02:05"))
    assert (LIFE in text) == (width >= WIDE)
    assert "\u2026" not in text


def test_escape_codes_of_others_do_not_reach_the_terminal() -> None:
    faults = (Fault(name="camera: \x1b[2J\u202egone [/]", count=3),)
    robot = message(RobotState, robot="r1", reason="line\nbreak \x07[red]", faults=faults)
    text = shown(100, Snapshot(robots={"r1": Seen(robot, 0.1)}))
    assert "camera: ?[2J?gone [/] 3" in text
    assert "line break ?[red]" in text
    assert not {"\x1b", "\x07", "\u202e"} & set(text)
