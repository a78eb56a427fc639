"""What another package adds by entry points works like what is ours (docs/extending.md)."""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import FakePredictor, fill_store

from services.robot_driver.kinds import make_link
from services.robot_driver.simulated.world import WORLDS, WorldError, load_world
from shared import plugins
from shared.config import Config
from shared.errors import ConfigError
from shared.metrics import MetricsLog
from shared.rl.memory import ReplayMemory
from shared.rl.policy import distribution
from shared.rl.retention.strategy import Discard, Situation, Strategy, discard
from shared.settings import load


class Oldest(Strategy):
    """Half of the memory goes, the oldest half."""

    def choose(self, there: Situation) -> Discard:
        ids = there.memory.ids[: len(there.memory) // 2].copy()
        return Discard(there.memory.capacity, ids, told={"unknown": 1})


class WithColumns(Oldest):
    columns = (("mine", "<u4"),)


class Link:
    def __init__(self, config: Config) -> None:
        self.config = config


def last(values: Any, config: Any) -> Any:
    return np.eye(len(values))[-1]


def track(table: str, row: Any) -> None:
    TOLD.append((table, dict(row)))
    raise OSError("no network")


TOLD: list[Any] = []
OLDEST, COLUMNS = Oldest(), WithColumns()


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A package is installed that adds one of each."""
    ring = tmp_path / "ring2.toml"
    ring.write_text((WORLDS / "plus.toml").read_text().replace('name = "plus"', 'name = "ring2"'))
    monkeypatch.setattr(sys.modules[__name__], "RING", ring, raising=False)
    added = [
        EntryPoint(name, f"{__name__}:{what}", f"corridor.{group}")
        for group, name, what in (
            ("robots", "desk2", "Link"),
            ("policies", "last", "last"),
            ("retention", "oldest", "OLDEST"),
            ("retention", "columns", "COLUMNS"),
            ("worlds", "ring2", "RING"),
            ("trackers", "log", "track"),
        )
    ]
    plugins.load.cache_clear()
    monkeypatch.setattr(
        plugins, "entry_points", lambda **chosen: EntryPoints(added).select(**chosen)
    )


def test_a_robot_is_reached_through_the_link_of_another_package() -> None:
    chosen = ["robot.kind=desk2", "robot.timing=realtime"]
    config = load(overrides=chosen)
    assert type(make_link(config)).__name__ == "Link"


def test_a_policy_gives_its_own_probabilities() -> None:
    config = load(overrides=["policy.kind=last", "policy.epsilon=1.0"]).policy
    assert distribution(np.array([0.5, 0.1, 0.0], np.float32), config).tolist() == [0, 0, 1]


def test_a_strategy_discards_and_tells_only_what_tables_know() -> None:
    memory = ReplayMemory(30)
    fill_store(memory, range(1, 41), [0] * 40)
    config = load(overrides=["memory.strategy=oldest", "memory.capacity=30"]).memory
    done = discard(Situation(memory, 1, config, FakePredictor(), seed=1))  # type: ignore[arg-type]
    assert memory.ids.tolist() == list(range(21, 41))
    assert "unknown" not in done.told
    broken = config.model_copy(update={"strategy": "columns"})
    with pytest.raises(ValueError, match="only those of the table may have columns"):
        discard(Situation(memory, 1, broken, FakePredictor(), seed=1))  # type: ignore[arg-type]


def test_a_world_is_found_by_its_name() -> None:
    assert load_world("ring2").name == "ring2"
    with pytest.raises(WorldError, match=r"there are: .*plus, ring2"):
        load_world("nowhere")


def test_a_name_that_nobody_has_is_refused_with_all_names_there_are() -> None:
    with pytest.raises(
        ConfigError, match=r"robot\.kind: expected 'sim', .* or 'desk2', got 'desk3'"
    ):
        load(overrides=["robot.kind=desk3"])


def test_a_tracker_gets_every_row_until_it_fails(tmp_path: Path) -> None:
    TOLD.clear()
    metrics = MetricsLog(tmp_path / "training.csv", ("episode", "loss"))
    for episode in (1, 2):
        metrics.write({"episode": episode, "loss": 0.5})
    metrics.close()
    assert TOLD == [("training", {"episode": 1, "loss": 0.5})]
    assert len(metrics.rows()) == 2
