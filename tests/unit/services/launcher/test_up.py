"""Signals that end `corridor up`, each in a process of its own."""

from __future__ import annotations

import subprocess
import sys

import pytest

CODE = """
import signal
from shared.threads import stop_on_signals
before = signal.{before}
signal.signal(signal.SIGHUP, before)
with stop_on_signals() as stop:
    signal.raise_signal(signal.SIGHUP)
    assert stop.wait({wait_s}) is {stops}
assert signal.getsignal(signal.SIGHUP) is before
"""


@pytest.mark.parametrize(
    ("before", "stops", "wait_s"),
    [("SIG_DFL", True, 5.0), ("SIG_IGN", False, 0.1)],
    ids=["a closed terminal stops a run", "under nohup a run outlives its terminal"],
)
def test_a_closed_terminal(before: str, stops: bool, wait_s: float) -> None:
    """And handlers are put back."""
    code = CODE.format(before=before, stops=stops, wait_s=wait_s)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
