"""Illnesses injected into real short runs are named; healthy runs have none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from experiments.runs.episode_row import episode_row
from experiments.single_process import SingleProcess
from services.actor import actor
from services.monitor.diagnose import Evidence, findings
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import load_world
from shared.config import Config
from shared.messages import WorldChange

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
EPISODES = 50
SMALL: dict[str, dict[str, Any]] = {
    "network": {"filters": 8},
    "policy": {"kind": "eps-greedy"},
    "episode": {"max_samples": 100, "horizon": 30},
    "memory": {"capacity": 800, "equalise_every": 40, "threshold_max_percent": 50},
    "learning": {
        "mini_batches_per_episode": 0, "fit_every": 5, "fit_epochs": 2, "fit_after_fill": True,
        "learning_rate": 0.001, "target_average": True, "augmentation": "mirror",
    },
}  # fmt: skip
"""The demo, smaller."""
Sections = dict[str, dict[str, Any]]
Inject = Callable[[SingleProcess, pytest.MonkeyPatch], None]


def found(seed: int, changes: Sections, inject: Inject, patch: pytest.MonkeyPatch) -> set[str]:
    """Illnesses of a run with changed settings and something done to its parts."""
    tree = {name: {**SMALL.get(name, {}), **changes.get(name, {})} for name in SMALL | changes}
    config = Config.model_validate({**tree, "run": {"seed": seed}})
    robot = SimRobot(config.robot, load_world("plus"), seed)
    loop, rows = SingleProcess(config, robot), []
    inject(loop, patch)
    for done in loop.run():
        if done.commit.episode:
            row = episode_row(loop, done, "run", 0.1 * done.commit.episode)
            rows.append({name: str(value) for name, value in row.items()})
        if done.commit.episode == EPISODES:
            break
    robot.close()
    return {each.illness for each in findings(Evidence(config, rows, loop.memory))}


def nothing(loop: SingleProcess, patch: pytest.MonkeyPatch) -> None:
    pass


def darken(loop: SingleProcess, patch: pytest.MonkeyPatch) -> None:
    robot, sense = loop.env.robot, loop.env.robot.sense
    patch.setattr(robot, "sense", lambda: replace(sense(), image=sense().image // 20))


def freeze(loop: SingleProcess, patch: pytest.MonkeyPatch) -> None:
    robot, sense = loop.env.robot, loop.env.robot.sense
    first = sense().image
    patch.setattr(robot, "sense", lambda: replace(sense(), image=first))


def stop_learner(loop: SingleProcess, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(loop.trainer, "learn", lambda *_: iter(()))


def stop_weights(loop: SingleProcess, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(loop.acting, "load", lambda *_: None)


def never_right(loop: SingleProcess, patch: pytest.MonkeyPatch) -> None:
    real = actor.decide
    patch.setattr(actor, "decide", lambda *a, **k: (real(*a, **k)[0] % 2, True))


def turn_left(loop: SingleProcess, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(
        actor,
        "decide",
        lambda *a, **k: (
            int(np.random.default_rng(k["step"]).choice(3, p=(0.02, 0.96, 0.02))),
            True,
        ),
    )


def drive_in_minus(loop: SingleProcess, patch: pytest.MonkeyPatch) -> None:
    change = WorldChange(kind="switch", world="minus", at_episode=10)
    assert loop.env.driver.change(change).accepted


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_healthy_run_has_none(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    assert found(seed, {}, nothing, monkeypatch) == set()


@pytest.mark.parametrize(
    ("illness", "changes", "inject"),
    [
        ("camera too dark", {}, darken),
        ("camera frozen", {}, freeze),
        ("learner stopped", {}, stop_learner),
        ("learning rate too high", {"learning": {"learning_rate": 0.1}}, nothing),
        ("action never taken", {}, never_right),
        ("robot circles", {}, turn_left),
        ("memory of one world only", {"memory": {"strategy": "normm"}}, drive_in_minus),
        ("equalising too often", {"memory": {"equalise_every": 1}}, nothing),
        ("threshold at its cap",
         {"memory": {"threshold_max_percent": 3, "raise_at_most": 999, "recompute_below": 999}},
         nothing),
        ("weights stale", {}, stop_weights),
    ],
)  # fmt: skip
def test_an_illness_is_named(
    illness: str, changes: Sections, inject: Inject, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert illness in found(1, changes, inject, monkeypatch)
