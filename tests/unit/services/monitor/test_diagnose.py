"""Each illness is named, and alone; a healthy run and one that has just begun have none."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import Images, fill_store, make_config, make_images
from fakes import message

from services.monitor import diagnose
from services.monitor.diagnose import Evidence, findings
from services.monitor.heartbeats import Seen, Snapshot
from shared.messages import ActorState, LearnerState, ReplayState, RobotState
from shared.rl.memory import ReplayMemory

CONFIG = make_config(
    episode={"max_samples": 60, "horizon": 20},
    memory={"capacity": 600, "equalise_every": 40},
    learning={"fit_every": 10, "mini_batches_per_episode": 0, "target_rule": "bump"},
)
LENGTH = 40
"""Samples of an episode."""
STEP_M = CONFIG.robot.step_m


def rows(count: int = 120, **changes: Any) -> list[dict[str, str]]:
    """Episodes of a healthy run; changes: values of a column, or functions of the episode."""
    made = []
    for e in range(1, count + 1):
        fit = e % 10 == 0
        row = {
            "episode": e, "stage": "run", "robot": "r1", "world": "plus", "bump": 1,
            "fitness": LENGTH, "actions": LENGTH, "samples": LENGTH, "loss": 0.1 if fit else "",
            "train_steps": 10 * (e // 10), "fits": e // 10, "weights_version": 1 + e // 10,
            "acting_version": 1 + (e - 1) // 10, "target_age": 0, "capacity": 600,
            "forward": 200, "left": 200, "right": 200, "by_world": "plus=600", "discarded": 40,
            "equalised": int(e % 40 == 0), "last_resort": 0, "threshold_percent": 7,
            "recomputed": int(e % 10 == 0),
            "seconds": 0.5 * e, "turn_seconds": 0.1,
        }  # fmt: skip
        row |= {name: change(e) if callable(change) else change for name, change in changes.items()}
        made.append({name: str(value) for name, value in row.items()})
    return made


def memory(
    count: int = 600, images: Images | None = None, actions: int = 3, circle: bool = False
) -> ReplayMemory:
    """What a robot saw that drove straight on, or round and round, episode after episode."""
    ids = np.arange(1, count + 1)
    made = ReplayMemory(600)
    rewards = np.where(ids % 2, 0.6, -0.6)
    fill_store(made, ids, ids % actions, rewards, images if images is not None else noise(count))
    made.rows["commit"] = made.rows["episode"] = 1 + (ids - 1) // LENGTH
    made.rows["step"] = step = (ids - 1) % LENGTH
    turn = step * STEP_M / 0.4
    made.rows["x_m"] = 0.4 * np.cos(turn) if circle else step * STEP_M
    made.rows["y_m"] = 0.4 * np.sin(turn) if circle else 0.0
    return made


def noise(count: int) -> Images:
    return make_images(count)


def at_once(episode: int) -> int:
    return 1 if episode % 3 == 0 else 80


REFUSED = "2026-01-01 replay WARNING episode r1/a/7 is refused: versions: weights 3 acted"
DIVERGED = "2026-01-01 learner ERROR episode 7: loss is nan; lower learning.learning_rate in a run"
LIVE = Snapshot(
    robots={"r1": Seen(message(RobotState, state="driving"), 0.0)},
    actors={"r1": Seen(message(ActorState), 0.0)},
    replay=Seen(message(ReplayState), 0.0),
    learner=Seen(message(LearnerState), 0.0),
)
HEALTHY = Evidence(CONFIG, rows(), memory(), LIVE)
CASES: list[tuple[str, dict[str, Any]]] = [
    ("camera frozen", {"memory": memory(images=np.repeat(noise(1), 600, axis=0))}),
    ("camera too dark", {"memory": memory(images=noise(600) // 30)}),
    ("camera shows nothing", {"memory": memory(images=100 + noise(600) // 64)}),
    ("learner stopped", {"episodes": rows(train_steps=lambda e: min(e // 10, 4), loss="")}),
    ("learner stopped", {"live": replace(LIVE, learner=None)}),
    ("replay stopped", {"live": replace(LIVE, replay=Seen(message(ReplayState), 9.0))}),
    ("robot stands",
     {"live": replace(LIVE, robots={"r1": Seen(message(RobotState, state="paused"), 0.0)})}),
    ("learning rate too high", {"episodes": rows(loss=lambda e: 3.0 if e % 10 == 0 else "")}),
    ("learning rate too high", {"log": [DIVERGED]}),
    ("loss does not fall",
     {"episodes": rows(400, loss=lambda e: 0.35 if e % 10 == 0 else "")}),
    ("action never taken", {"memory": memory(actions=2)}),
    ("robot circles", {"memory": memory(circle=True)}),
    ("memory of one world only",
     {"episodes": rows(world=lambda e: "minus" if e < 60 else "plus")}),
    ("memory out of balance", {"episodes": rows(forward=590, left=5, right=5)}),
    ("equalising too often", {"episodes": rows(equalised=1)}),
    ("threshold at its cap", {"episodes": rows(threshold_percent=7, recomputed=1)}),
    ("candidates run out", {"episodes": rows(last_resort=20)}),
    ("weights stale", {"episodes": rows(acting_version=1)}),
    ("weights stale", {"episodes": rows(target_age=150)}),
    ("samples refused", {"log": [REFUSED]}),
    ("samples refused",
     {"live": replace(LIVE, actors={"r1": Seen(message(ActorState, refused_episodes=2), 0.0)})}),
    ("samples lost", {"episodes": rows(samples=20)}),
    ("bumps at once", {"episodes": rows(actions=at_once, samples=at_once)}),
    ("no better than chance", {"episodes": rows(actions=12, samples=12)}),
    ("too slow", {"episodes": rows(seconds=lambda e: 100.0 * e)}),
]  # fmt: skip


@pytest.mark.parametrize(("illness", "changes"), CASES)
def test_an_illness_is_named_and_nothing_else(illness: str, changes: dict[str, Any]) -> None:
    (found,) = findings(replace(HEALTHY, **changes))
    assert found.illness == illness
    assert all(vars(found).values())


def test_weights_of_one_of_two_robots_are_as_old_as_the_episode_of_the_other() -> None:
    two = {"robot": lambda e: f"r{e % 2}", "weights_version": lambda e: e}
    late = rows(**two, acting_version=lambda e: e - 2)
    assert findings(replace(HEALTHY, episodes=late)) == []
    (found,) = findings(replace(HEALTHY, episodes=rows(**two, acting_version=lambda e: e - 3)))
    assert found.illness == "weights stale"


@pytest.mark.parametrize("count", [0, 1, 5, 40, 120])
@pytest.mark.parametrize("samples", [0, 60, 600])
def test_nothing_is_found_in_a_healthy_run_however_short(count: int, samples: int) -> None:
    assert findings(Evidence(CONFIG, rows(count), memory(samples), LIVE)) == []
    assert findings(Evidence(CONFIG, rows(count))) == []


def test_every_text_is_of_an_illness_that_is_looked_for() -> None:
    file = Path(diagnose.__file__).with_name("illnesses.toml")
    assert set(tomllib.loads(file.read_text())) == {illness for illness, _ in CASES}
    page = (Path(__file__).parents[4] / "docs" / "operations.md").read_text()
    assert all(f"`{illness}`" in page for illness, _ in CASES)


def test_what_is_looked_for_in_logs_is_what_services_write() -> None:
    root = Path(diagnose.__file__).parents[1]
    assert " is refused: {reason}" in (root / "replay" / "service.py").read_text()
    assert "lower learning.learning_rate" in (root / "learner" / "service.py").read_text()


def test_it_is_light() -> None:
    heavy = "torch pybullet matplotlib zenoh"
    code = "import sys, services.monitor.diagnose as _; print(sys.modules.keys() & sys.argv[1:])"
    command = [sys.executable, "-c", code, *heavy.split()]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
