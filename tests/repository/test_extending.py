"""The recipes of docs/extending.md, followed in a copy: few files, and what they make works."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/extending.md").read_text()
SECTION = re.compile(r"^## (.+?)\n(.*?)(?=^## |\Z)", re.MULTILINE | re.DOTALL)
BLOCK = re.compile(r"^```(\w+) (\S+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
RECIPES = dict(SECTION.findall(PAGE))


class Use(NamedTuple):
    """What a recipe must make possible."""

    most_files: int
    script: str


USES = {
    "A retention strategy": Use(
        2,
        """
import sys
from pathlib import Path

from builders import FakePredictor, make_episode

from services.replay.storage import Storage
from shared.config import MemoryConfig
from shared.rl.retention.strategy import strategy
from shared.rl.schedule import Moment
from shared.rl.turn import maintain
from shared.run_record import REPLAY_COLUMNS

config = MemoryConfig(capacity=30, fill="none", strategy="thin")
told = []
for number in (1, 2, 3):
    storage = Storage(Path(sys.argv[1]), config, "run/1")
    memory = storage.load()
    storage.commit(make_episode(20, seed=number))
    pending = storage.pending(number - 1)
    memory.append(pending.rows, pending.images)
    done = maintain(memory, Moment(number), config, FakePredictor(), seed=1)
    storage.apply_turn(pending, memory, done)
    assert done.discarded.told["threshold_percent"] == 1, done
    told.append(done.discarded.told["discards"])
    loaded = storage.load()
    assert loaded.rows["outlived"].tolist() == memory.rows["outlived"].tolist()
    loaded.check_valid()
    storage.close()
assert told == [0, 1, 2], told
assert memory.rows["outlived"].tolist() == [2] * 10 + [1] * 10, memory.rows["outlived"]
assert strategy("thin").state(memory) == {"most_outlived": 2}
assert "discards" in REPLAY_COLUMNS
""",
    ),
    "A selection policy": Use(
        2,
        """
import numpy as np

from shared.rl.policy import choose, distribution
from shared.settings import load

config = load(overrides=["policy.kind=second-best", "policy.epsilon=0.25"]).policy
values = np.array([0.1, -0.5, 0.3], np.float32)
assert distribution(values, config).tolist() == [0.25, 0.0, 0.75]
draw = np.random.default_rng(1)
chosen = [choose(values, config, draw) for _ in range(400)]
assert {action for action, greedy in chosen if not greedy} == {0}
assert {action for action, greedy in chosen if greedy} == {2}
""",
    ),
    "An action set": Use(
        6,
        """
import numpy as np
from cluster import make_config

from experiments.single_process import SingleProcess
from services.robot_driver.motion_control import action_velocity
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import load_world
from shared.facts import MIRRORED
from shared.rl.memory import ReplayMemory

config = make_config("five", memory={"capacity": 300}, learning={"fit_every": 2})
half = action_velocity(config, 4)
assert half.turn_rad_s == -0.5 * config.robot.turn_rad_s
assert MIRRORED == (0, 2, 1, 4, 3)
world = load_world("plus")
loop = SingleProcess(config, SimRobot(config.robot, world, config.run.seed))
for done in loop.run():
    if done.commit.episode == 4:
        break
    assert done.commit.commit < 60, done.commit
assert len(loop.memory) <= 300
counts = np.bincount(loop.memory.rows["action"], minlength=5)
assert counts.min() > 0, counts
loop.memory.check_valid()
assert max(loop.memory.rows["reward"]) <= 1.0
""",
    ),
    "A robot": Use(
        4,
        """
from services.robot_driver.kinds import make_robot
from services.robot_driver.robot import STANDSTILL, Velocity
from shared.settings import load

robot = ("kind=desk", "timing=realtime", "recovery=back-off", "desk.grey=90")
config = load(overrides=[f"robot.{setting}" for setting in robot])
assert config.fingerprint() == load(overrides=["robot.timing=realtime"]).fingerprint()
desk = make_robot(config)
try:
    assert desk.feel().pose.x_m == 0.0
    desk.drive(Velocity(0.4, 0.0, 0.0))
    assert not desk.run(0.5, stop_on_contact=True)
    desk.drive(STANDSTILL)
    desk.run(0.2, stop_on_contact=True)
    there = desk.sense()
    assert 0.05 < there.pose.x_m < 0.4, there.pose
    assert there.image.shape == (50, 75) and (there.image == 90).all()
    assert not there.contact
finally:
    desk.close()
""",
    ),
    "A world": Use(
        1,
        """
from services.robot_driver.atlas.survey import problems_in
from services.robot_driver.kinds import make_robot
from services.robot_driver.robot import Velocity
from services.robot_driver.simulated.world import world_path
from shared.settings import load

config = load(overrides=["robot.world=ring"])
assert problems_in(world_path("ring"), config) == []
robot = make_robot(config)
assert robot.sense().image.std() > 5
robot.drive(Velocity(0.6, 0.0, 0.0))
assert robot.run(60.0, stop_on_contact=True), "the robot met no wall"
robot.close()
""",
    ),
    "A setting": Use(
        2,
        """
import numpy as np

from shared.rl.reward import episode_rewards
from shared.settings import load

config = load(env={"CORRIDOR_REWARD__DISTANCE_POWER": "2"}).reward
way = np.array([[0.0, 0.0], [0.5, 0.0]])
reward = episode_rewards(
    way, np.zeros(1), bump=False, horizon=1, max_distance_m=1.0, config=config
)
assert reward == np.float32(0.8 * 0.25)
""",
    ),
    "A message": Use(
        4,
        """
import sys
from pathlib import Path

from builders import make_episode
from cluster import Cluster, make_config

from shared.keys import EPISODE, WORLDS
from shared.messages import EpisodeAck, Worlds, WorldsRequest

config = make_config("message", memory={"fill": "none"})
with Cluster(config, Path(sys.argv[1])) as cluster:
    cluster.start("router", "replay")
    cluster.wait(lambda: cluster.replay() is not None, 60, "replay is there")
    assert cluster.bus.request(WORLDS, WorldsRequest(), Worlds).names == ()
    ack = cluster.bus.request(EPISODE, make_episode(20), EpisodeAck, ident="robot1")
    assert ack.accepted, ack
    assert cluster.bus.request(WORLDS, WorldsRequest(), Worlds).names == ("plus",)
""",
    ),
}


def test_every_recipe_is_followed() -> None:
    assert set(RECIPES) == set(USES)


@pytest.mark.parametrize("title", USES)
def test_a_recipe_works(title: str, tmp_path: Path) -> None:
    copy = tmp_path / "code"
    for folder in ("shared", "services", "experiments"):
        shutil.copytree(ROOT / folder, copy / folder, ignore=shutil.ignore_patterns("__pycache__"))
    files = {path: follow(copy, path, text) for _, path, text in BLOCK.findall(RECIPES[title])}
    assert 1 <= len(files) <= USES[title].most_files, sorted(files)
    python = [path for path in files if path.endswith(".py")]
    for check in (["check", "--no-cache"], ["format", "--check", "--no-cache"]) if python else ():
        run(["ruff", *check, "--config", str(ROOT / "pyproject.toml"), *python], copy)
    run(["-P", "-W", "error", "-c", USES[title].script, str(tmp_path / "run")], copy)


def follow(copy: Path, path: str, text: str) -> None:
    """Write a new file, or change the only place in an existing one that a diff shows."""
    file = copy / path
    if not re.search(rf"^```diff {re.escape(path)}$", PAGE, re.MULTILINE):
        assert not file.exists(), path
        file.write_text(text)
        return
    lines = [(line[:1] or " ", line[1:]) for line in text.splitlines()]
    old = "".join(f"{line}\n" for sign, line in lines if sign != "+")
    new = "".join(f"{line}\n" for sign, line in lines if sign != "-")
    before = file.read_text()
    assert before.count(old) == 1, (path, old)
    file.write_text(before.replace(old, new))


def run(arguments: list[str], copy: Path) -> None:
    """Run this Python in the copy, with the helpers of the tests at hand."""
    command = [sys.executable, *(["-m"] if arguments[0] == "ruff" else []), *arguments]
    path = os.pathsep.join((str(copy), str(ROOT / "tests"), str(ROOT)))
    environment = {**os.environ, "PYTHONPATH": path}
    done = subprocess.run(
        command, cwd=copy, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
