"""Random events over all processes of a run: nothing is lost, and no robot moves under a halt."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.chaos import play

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]


def test_sixty_random_events(tmp_path: Path, run_name: str) -> None:
    counted = play(seed=5, events=60, run_name=run_name, place=tmp_path)
    assert counted["episodes_learnt"] > 3
    assert counted["submissions"] > counted["episodes_learnt"]
