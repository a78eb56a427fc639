"""Signals that end `corridor up`."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from services.launcher.up import stop_on_signals


@pytest.fixture(autouse=True)
def _handlers_as_before() -> Iterator[None]:
    before = signal.getsignal(signal.SIGHUP)
    yield
    signal.signal(signal.SIGHUP, before)


def test_a_closed_terminal_stops_a_run_and_handlers_are_put_back() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    with stop_on_signals() as stop:
        signal.raise_signal(signal.SIGHUP)
        assert stop.wait(5.0)
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_DFL


def test_under_nohup_a_run_outlives_its_terminal() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with stop_on_signals() as stop:
        signal.raise_signal(signal.SIGHUP)
        assert not stop.is_set()
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
