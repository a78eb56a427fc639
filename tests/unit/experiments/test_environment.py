"""The corridors as Gymnasium environments: their rules, bumps, seeds, pictures."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.utils.env_checker import check_env

from experiments import environment
from experiments.environment import LIFE, MAX_EPISODE_STEPS, PICTURE_PX, CorridorEnv, env_id
from services.robot_driver.driver import Driver
from services.robot_driver.robot import Pose
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import WORLDS, WorldError, load_world
from shared.config import Config
from shared.messages import image_array

NAMES = sorted(path.stem for path in WORLDS.glob("*.toml"))
FREE = Pose(4.2, 0.0, math.pi / 2.0)


@pytest.fixture
def env() -> Iterator[CorridorEnv]:
    env = CorridorEnv("plus")
    yield env
    env.close()


def drive_to_bump(env: gymnasium.Env[Any, Any], action: int = 0) -> tuple[list[float], Any]:
    """Rewards of the same action until an episode is over, and the last step."""
    rewards = []
    while True:
        step = env.step(np.int64(action))
        rewards.append(float(step[1]))
        if step[2] or step[3]:
            return rewards, step


@pytest.mark.parametrize("world", NAMES)
def test_every_world_has_a_name_in_gymnasium_and_keeps_its_rules(world: str) -> None:
    made = gymnasium.make(f"experiments.environment:{env_id(world)}", render_mode="rgb_array")
    inner = made.unwrapped
    assert isinstance(inner, CorridorEnv)
    assert inner.robot.world.name == world
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(inner)
    made.close()


def test_names_begin_with_a_capital() -> None:
    assert [env_id(name) for name in ("plus", "minus", "i16c")] == [
        "corridor/Plus-v0", "corridor/Minus-v0", "corridor/I16c-v0",
    ]  # fmt: skip


def test_a_world_of_ones_own_is_registered_by_its_file(tmp_path: Path) -> None:
    file = tmp_path / "ring2.toml"
    file.write_text((WORLDS / "plus.toml").read_text().replace('name = "plus"', 'name = "ring2"'))
    env = gymnasium.make(environment.register(file))
    env.reset(seed=1)
    inner = env.unwrapped
    assert isinstance(inner, CorridorEnv)
    assert (inner.seen.world, inner.robot.world.name) == ("ring2", "ring2")
    env.close()
    del gymnasium.registry[env_id("ring2")]


@pytest.mark.parametrize(
    "vector", [gymnasium.vector.SyncVectorEnv, gymnasium.vector.AsyncVectorEnv]
)
def test_environments_of_several_worlds_run_beside_each_other(vector: Any) -> None:
    """Each as if it were alone; infos are arrays of numbers."""
    names = ("minus", "plus")
    together = vector([lambda name=name: gymnasium.make(env_id(name)) for name in names])
    images, _ = together.reset(seed=[3, 4])
    _, rewards, *_, infos = together.step(np.array([0, 1]))
    together.close()
    for number, (name, action) in enumerate(zip(names, (0, 1), strict=True)):
        alone = CorridorEnv(name)
        assert np.array_equal(alone.reset(seed=3 + number)[0], images[number])
        _, reward, _, _, info = alone.step(np.int64(action))
        assert reward == rewards[number]
        assert info == {key: infos[key][number] for key in info}
        alone.close()


def test_a_bump_ends_an_episode_and_the_next_one_begins_after_backing_off(env: CorridorEnv) -> None:
    env.reset(seed=1)
    rewards, (image, reward, terminated, truncated, info) = drive_to_bump(env)
    assert (reward, terminated, truncated, info["bump"]) == (-1.0, True, False, 1)
    assert {type(value) for value in info.values()} == {float, int}
    assert rewards[:-1] == pytest.approx([1.0] * (len(rewards) - 1))
    assert env.robot.contact
    assert env.driver.recoveries == 0
    after, info = env.reset()
    assert env.driver.recoveries == 1
    assert env.seen.bump
    assert info["bump"]
    assert not env.robot.contact
    assert not np.array_equal(image, after)


def test_at_a_bump_the_image_acted_on_comes_once_more(env: CorridorEnv) -> None:
    image, _ = env.reset(seed=1)
    while True:
        seen, _, bumped, _, _ = env.step(np.int64(0))
        if bumped:
            break
        image = seen
    assert np.array_equal(seen, image)


def test_the_driver_is_driven_as_ever(env: CorridorEnv) -> None:
    """The same observations, bumps and recoveries as actions executed one by one."""
    config = Config()
    robot = SimRobot(config.robot, load_world("plus"), config.run.seed)
    driver = Driver(config, robot, LIFE)
    expected = driver.observe()
    env.reset()
    for action in np.random.default_rng(5).integers(3, size=120):
        assert env.seen == expected
        driver.execute(int(action), LIFE)
        expected = driver.observe()
        image, _, bumped, _, _ = env.step(action)
        if bumped:
            image, _ = env.reset()
        assert np.array_equal(image[:, :, 0], image_array(expected.image))
    assert driver.bumps > 2
    assert env.driver.bumps == driver.bumps
    robot.close()


def test_without_a_bump_a_registered_episode_is_cut_off_and_goes_on_from_there() -> None:
    env = gymnasium.make(
        "experiments.environment:corridor/Plus-v0", max_episode_steps=3, disable_env_checker=True
    )
    env.reset(seed=1)
    rewards, (image, _, terminated, truncated, _) = drive_to_bump(env)
    assert (len(rewards), terminated, truncated) == (3, False, True)
    again, _ = env.reset()
    assert np.array_equal(image, again)
    env.close()
    spec = gymnasium.spec("corridor/Plus-v0")
    assert spec.max_episode_steps == MAX_EPISODE_STEPS == Config().episode.max_samples


def test_a_seed_draws_a_start_and_repeats_everything(env: CorridorEnv) -> None:
    drawn = {(info["x_m"], info["y_m"]) for _, info in (env.reset(seed=seed) for seed in range(20))}
    assert drawn == {(start.x_m, start.y_m) for start in env.world.starts}
    runs = []
    for _ in range(2):
        first, _ = env.reset(seed=7)
        rewards, (last, *_) = drive_to_bump(env)
        after, _ = env.reset()
        runs.append((first.tobytes(), rewards, last.tobytes(), after.tobytes()))
    assert runs[0] == runs[1]


def test_a_pose_puts_the_robot_there_with_nothing_behind_it(env: CorridorEnv) -> None:
    env.reset(seed=1)
    for _ in range(5):
        env.step(np.int64(1))
    env.reset(seed=2, options={"pose": FREE})
    seen = env.seen
    assert Pose(seen.x_m, seen.y_m, seen.heading_rad) == FREE == env.robot.pose
    assert (seen.sequence, seen.stamp_s, env.robot.laps.net) == (0, 0.0, 0)


def test_wrong_use_is_refused(env: CorridorEnv) -> None:
    with pytest.raises(ResetNeeded):
        env.step(np.int64(0))
    env.reset(seed=1)
    with pytest.raises(InvalidAction, match=r"0\.\.2, got .*3"):
        env.step(np.int64(3))
    with pytest.raises(ValueError, match="needs a seed"):
        env.reset(options={"pose": FREE})
    with pytest.raises(ValueError, match="inside a wall"):
        env.reset(seed=1, options={"pose": Pose(0.0, 0.0, 0.0)})
    drive_to_bump(env)
    with pytest.raises(ResetNeeded):
        env.step(np.int64(0))
    with pytest.raises(WorldError, match="no world named 'nowhere'"):
        CorridorEnv("nowhere")
    with pytest.raises(ValueError, match="expected None or 'rgb_array', got 'human'"):
        CorridorEnv(render_mode="human")
    with pytest.raises(ValueError, match="expected one of progress, distance, got 'fame'"):
        CorridorEnv(reward="fame")


def test_pictures_are_in_colour_and_only_on_request(env: CorridorEnv) -> None:
    env.reset(seed=1)
    assert env.render() is None
    seeing = CorridorEnv(robot=env.robot, render_mode="rgb_array")
    with pytest.raises(ResetNeeded):
        _ = seeing.seen
    picture = seeing.render()
    assert picture is not None
    assert picture.shape == (PICTURE_PX[1], PICTURE_PX[0], 3)
    assert (picture.max(axis=2) > picture.min(axis=2)).any()
