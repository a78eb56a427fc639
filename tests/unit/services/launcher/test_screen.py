"""Output that nobody reads holds up nobody, not even the end of the process."""

from __future__ import annotations

import os
import subprocess
import sys

from benchmarks.terminals import full_pipe

CODE = """
from services.launcher.live import RunView
from services.launcher.screen import Screen, say
from services.monitor.heartbeats import Snapshot

with Screen() as screen:
    for number in range(3):
        screen.show(RunView("demo", "tcp/127.0.0.1:1", 1.0, Snapshot(), note=f"note {number}"))
say("corridor: the last line", 1)
"""


def output_of(write: int) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", CODE], stdout=write, stderr=subprocess.PIPE)


def test_a_full_pipe_delays_neither_the_views_nor_the_end() -> None:
    with full_pipe() as write, output_of(write) as process:
        _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, b"")


def test_a_pipe_that_is_closed_ends_the_view_only() -> None:
    read, write = os.pipe()
    os.close(read)
    with output_of(write) as process:
        _, errors = process.communicate(timeout=60)
    os.close(write)
    assert process.returncode == 0
    assert b"the live view ends" in errors
    assert b"nobody reads 'corridor: the last line'" in errors


def test_the_newest_view_and_the_last_line_are_shown() -> None:
    with output_of(subprocess.PIPE) as process:
        output, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, b"")
    lines = output.decode().splitlines()
    assert lines[-2].endswith("note 2")
    assert lines[-1] == "corridor: the last line"
