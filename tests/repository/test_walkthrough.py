"""docs/walkthrough.md: a sample passes the functions that the page names, in that order."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from builders import FakePredictor, make_episode

from experiments.single_process import SingleProcess
from services.learner.mirror import Mirror
from services.replay.storage import Storage
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import load_world
from shared.config import Config, MemoryConfig
from shared.rl.schedule import Moment
from shared.rl.turn import maintain

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/walkthrough.md").read_text()
STATION = re.compile(r"`([\w/]+\.py:[\w.]+)`")
SECTIONS = {text.splitlines()[0]: STATION.findall(text) for text in PAGE.split("\n## ")[1:]}
STATIONS = [station for stations in SECTIONS.values() for station in stations]
PROCESSES = {
    "services/robot_driver/service.py",
    "services/actor/service.py",
    "services/actor/session.py",
    "services/actor/courier.py",
    "services/replay/service.py",
    "services/replay/worker.py",
    "services/learner/service.py",
}
"""Loops that only exist in processes with a bus: tests/system runs them."""


@contextmanager
def traced(called: dict[str, int]) -> Iterator[None]:
    """Number the functions of ours by the order of their first calls."""

    def note(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(f"{ROOT}/s"):
            name = f"{Path(code.co_filename).relative_to(ROOT)}:{code.co_qualname}"
            called.setdefault(name, len(called))

    sys.setprofile(note)
    try:
        yield
    finally:
        sys.setprofile(None)


def drive_and_learn(called: dict[str, int]) -> None:
    """A run in one process, until RMM has searched, an equalisation and a fit were due."""
    config = Config.model_validate(
        {
            "episode": {"max_samples": 60, "horizon": 20},
            "network": {"filters": 4},
            "memory": {"capacity": 120, "equalise_every": 2},
            "learning": {"batch_size": 16, "fit_every": 2, "fit_epochs": 1},
        }
    )
    robot = SimRobot(config.robot, load_world("plus"), config.run.seed)
    with traced(called):
        for done in SingleProcess(config, robot).run():
            if done.commit.episode == 2:
                break


def store_and_mirror(called: dict[str, int], folder: Path) -> None:
    """One more episode over disk into a full memory, and on to the learner's copy."""

    class FeedBus:
        def request_many(self, _: Any, request: Any, *types: Any, **__: Any) -> Any:
            if hasattr(request, "since"):
                return storage.feed.changes(request.since, request.upto, request.lineage)
            return storage.feed.snapshot()

    def turn(number: int) -> None:
        storage.commit(make_episode(20, seed=number))
        pending = storage.pending(number - 1)
        assert pending is not None
        memory.append(pending.rows, pending.images)
        done = maintain(memory, Moment(number), config, FakePredictor(), seed=1)
        position = storage.apply_turn(pending, memory, done)
        mirror.reach(FeedBus(), position.change, position.lineage)  # type: ignore[arg-type]

    config = MemoryConfig(capacity=30, fill="none", strategy="normm")
    storage, mirror = Storage(folder, config, "run/1"), Mirror()
    memory = storage.load()
    turn(1)
    with traced(called):
        turn(2)
    storage.close()
    assert mirror.samples.ids.tolist() == memory.ids.tolist()


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, int]]:
    first: dict[str, int] = {}
    second: dict[str, int] = {}
    drive_and_learn(first)
    store_and_mirror(second, tmp_path_factory.mktemp("replay"))
    return [first, second]


def names(path: str) -> set[str]:
    """Qualified names of all functions in a file."""

    def inside(node: ast.AST, before: str) -> Iterator[str]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, (ast.FunctionDef, ast.ClassDef)):
                yield before + child.name
                yield from inside(child, f"{before}{child.name}.")

    return set(inside(ast.parse((ROOT / path).read_text()), ""))


def test_there_are_stations_everywhere() -> None:
    assert len(SECTIONS) == 8
    assert all(SECTIONS.values())
    assert len(STATIONS) > 35


@pytest.mark.parametrize("station", STATIONS)
def test_a_station_exists(station: str) -> None:
    path, name = station.split(":")
    assert name in names(path)


def test_a_sample_passes_every_station(runs: list[dict[str, int]]) -> None:
    passed = set().union(*runs)
    missed = {station for station in STATIONS if station not in passed}
    assert {station.split(":")[0] for station in missed} == PROCESSES


@pytest.mark.parametrize("section", SECTIONS)
def test_stations_come_in_this_order(section: str, runs: list[dict[str, int]]) -> None:
    for called in runs:
        order = [called[station] for station in SECTIONS[section] if station in called]
        assert order == sorted(order), [s for s in SECTIONS[section] if s in called]
