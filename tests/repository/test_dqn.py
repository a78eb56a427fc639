"""The baseline beside ours: equal work, equal evaluation, its own reward; without its library."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

from benchmarks import dqn
from benchmarks.dqn import EVALUATIONS, shared_config
from experiments.drives.choosers import Chooser, uniform
from experiments.environment import CorridorEnv
from experiments.plans.plan import stage_config
from experiments.plans.scales import load_plan
from experiments.records import EVALUATION_COLUMNS
from experiments.report.run_folder import read_info
from services.robot_driver.robot import Pose
from shared.config import Config
from shared.facts import FORWARD, FORWARD_LEFT
from shared.run_record import read_csv


class Pretender:
    """Learns nothing, and trains a mini-batch every four actions."""

    greedy: Chooser = staticmethod(uniform)

    def __init__(self) -> None:
        self.actions = 0

    def drive(self, actions: int) -> None:
        self.actions += actions

    @property
    def train_steps(self) -> int:
        return self.actions // 4


def invoked(words: str) -> Result:
    return CliRunner().invoke(dqn.app, words.split())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a run leaves behind."""
    out = tmp_path_factory.mktemp("baseline") / "seed-1"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(importlib.util, "find_spec", lambda name: name)
        patched.setattr(dqn, "Dqn", lambda config, reward: Pretender())
        done = invoked(f"--actions 207 --starts 1 --drive-actions 30 --out {out}")
    assert done.exit_code == 0, done.output
    return out


def test_a_run_is_evaluated_at_equal_intervals_as_ours_is(folder: Path) -> None:
    rows = read_csv(folder / "evaluations.csv", EVALUATION_COLUMNS)
    assert [int(row["total_actions"]) for row in rows] == [
        207 * n // EVALUATIONS for n in range(1, EVALUATIONS + 1)
    ]
    assert [row["label"] for row in rows] == ["every"] * (EVALUATIONS - 1) + ["end"]
    assert {row["actions"] for row in rows} == {"30"}
    assert rows[-1]["train_steps"] == "51"


def test_reports_can_read_what_was_run(folder: Path) -> None:
    info = read_info(folder / "run.json")
    assert (info.experiment, info.actions, info.train_steps, info.seed) == (
        "dqn-progress", 207, 51, 1,
    )  # fmt: skip
    assert info.complete
    assert "--actions 207" in info.command
    assert str(folder) not in info.command


def test_what_is_shared_with_ours_comes_from_the_plan() -> None:
    ours = load_plan("plus-minus", "tenth")
    config, last = (
        shared_config(ours, 5, "distance", 2),
        stage_config(ours, len(ours.stages) - 1, 5),
    )
    assert (config.network, config.robot, config.episode) == (
        last.network, last.robot, last.episode,
    )  # fmt: skip
    assert (config.memory.capacity, config.run.seed) == (last.memory.capacity, 5)
    assert (config.run.name, config.numerics.learner.threads) == ("dqn-distance", 2)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("--like nothing --out x", "got 'nothing'"),
        ("--reward fame --out x", "got 'fame'"),
        ("--actions 0 --out x", "--actions"),
        ("", "--out"),
    ],
)
def test_wrong_words_are_refused(words: str, complaint: str) -> None:
    done = invoked(words)
    assert done.exit_code == 2
    assert complaint in done.stderr


def test_without_its_library_one_line_tells_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    done = invoked(f"--out {tmp_path / 'out'}")
    assert done.exit_code == 2
    assert done.stderr.count("\n") == 1
    assert "make bench-peers" in done.stderr
    assert not (tmp_path / "out").exists()


def test_distance_is_from_50_actions_ago_or_the_begin_of_the_episode() -> None:
    config = Config.model_validate({"episode": {"horizon": 4, "max_samples": 9}})
    env = CorridorEnv(config=config, reward="distance")
    start = {"seed": 1, "options": {"pose": Pose(3.8, -2.5, math.pi / 2)}}
    env.reset(**start)
    straight = [env.step(np.int64(FORWARD))[1] for _ in range(7)]
    assert straight == pytest.approx([0.25, 0.5, 0.75, 1.0, 1.0, 1.0, 1.0])
    env.reset(**start)
    assert env.step(np.int64(FORWARD))[1] == pytest.approx(0.25)
    while True:
        _, reward, bumped, _, _ = env.step(np.int64(FORWARD))
        if bumped:
            break
    assert reward == -1.0
    env.close()


def test_distance_tells_circling_from_driving() -> None:
    config = Config()
    env = CorridorEnv(config=config, reward="distance")
    env.reset(seed=1, options={"pose": Pose(4.2, 0.0, math.pi / 2)})
    rewards = [env.step(np.int64(FORWARD_LEFT))[1] for _ in range(100)]
    assert max(rewards) < 0.12
    env.close()
