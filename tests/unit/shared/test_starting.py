"""A service that is asked to stop while it starts comes to a clean end, and loses nothing."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from textwrap import dedent
from typing import Any

import pytest

from services.robot_driver import service as driver_service
from services.robot_driver.driver import Driver
from services.robot_driver.kinds import make_robot
from shared import statefile
from shared.config import Config
from shared.service import Stopped

BEGIN = """
import signal
from shared.service import StopFlag, answer_signals, starting
"""


def in_its_own_process(code: str) -> None:
    """Run a test that sends itself a signal: a process that tests share may not survive it."""
    done = subprocess.run(
        [sys.executable, "-c", BEGIN + dedent(code)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_sigterm_waits_until_the_service_can_answer_it() -> None:
    in_its_own_process(
        """
        stop = StopFlag()
        with starting():
            signal.raise_signal(signal.SIGTERM)
            assert not stop.is_set()
            answer_signals(stop)
            assert stop.is_set()
        assert stop.reason == "SIGTERM"
        """
    )


def test_what_an_earlier_start_held_back_is_forgotten() -> None:
    in_its_own_process(
        """
        with starting():
            signal.raise_signal(signal.SIGTERM)
        stop = StopFlag()
        with starting():
            answer_signals(stop)
        assert not stop.is_set()
        """
    )


def test_a_driver_stopped_before_it_is_up_keeps_what_it_was_to_continue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = Config()
    path = tmp_path / "robot" / config.robot.id / driver_service.STATE
    robot = make_robot(config)
    driver = Driver(config, robot, "a" * 12)
    for action in (0, 1, 1, 2):
        driver.execute(action)
    saved = driver.saved()
    robot.close()
    statefile.save(path, saved)

    @contextmanager
    def never_up(*_: Any, **__: Any) -> Iterator[Any]:
        assert not path.exists()  # it has been taken up
        raise Stopped("waiting for the router")
        yield

    monkeypatch.setattr(driver_service, "service", never_up)
    driver_service.run(config, tmp_path, "b" * 12)
    again = statefile.read(path)
    assert again == {**saved, "lives": ["b" * 12, "a" * 12], "_executed": [2, ""]}
