"""Many robots in one scene drive as if each were alone, to the last bit: a naive loop tells."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest

from experiments.drives.choosers import (
    GREEDY,
    IMAGES_PER_PASS,
    Planned,
    Predicts,
    greedy,
    side_by_side,
    uniform,
)
from experiments.drives.frozen_drives import drive, evaluate, figures_of
from experiments.drives.places import SEED, start_poses
from experiments.drives.traces import Trace
from experiments.environment import CorridorEnv
from services.robot_driver.robot import Pose
from services.robot_driver.simulated import sim
from shared.config import ActorNumerics, NetworkConfig
from shared.messages import Observation, image_array
from shared.rl.draws import generator
from shared.rl.network import initialised, to_bytes
from shared.rl.policy import choose
from shared.rl.predictor import Predictor

STARTS, ACTIONS = 5, 40


@pytest.fixture(params=["plus", "i16c"])
def env(request: pytest.FixtureRequest) -> Iterator[CorridorEnv]:
    env = CorridorEnv(request.param)
    yield env
    env.close()


class Network:
    """What it says hangs on late digits of the predictions, rounded: every action comes up.

    With few decimals several actions are often as good.
    """

    def __init__(self, numerics: ActorNumerics, decimals: int) -> None:
        network = NetworkConfig(filters=4)
        self._predictor = Predictor(network, numerics)
        self._predictor.load(0, to_bytes(initialised(network, seed=3)))
        self._decimals = decimals
        self.ties = 0
        self.passes: list[int] = []

    def all_values(self, images: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
        values = np.round(self._predictor.all_values(images) * 1e4 % 1.0, self._decimals)
        self.ties += int(((values == values.max(axis=1, keepdims=True)).sum(axis=1) > 1).sum())
        self.passes.append(len(images))
        return values


class Turn(NamedTuple):
    """What one action led to."""

    bump: bool
    way_m: float
    after: Observation


def alone(
    env: CorridorEnv, network: Predicts, number: int, pose: Pose, actions: int
) -> tuple[list[Turn], tuple[int, int]]:
    """One robot after the other, one prediction for one action; also laps left and right."""
    env.reset(seed=number, options={"pose": pose})
    seen = env.seen
    draw, turns = generator(SEED, "action", number), []
    for _ in range(actions):
        values = network.all_values(image_array(seen.image)[None])[0]
        before = env.robot.pose
        bump = env.step(np.int64(choose(values, GREEDY, draw)[0]))[2]
        here = env.robot.pose
        way_m = math.hypot(here.x_m - before.x_m, here.y_m - before.y_m)
        if bump:
            env.reset()
        seen = env.seen
        turns.append(Turn(bump, way_m, seen))
    return turns, (env.robot.laps.left, env.robot.laps.right)


def trace_of(world: str, pose: Pose, turns: list[Turn], laps: tuple[int, int]) -> Trace:
    poses = [(pose.x_m, pose.y_m, pose.heading_rad)]
    poses += [(t.after.x_m, t.after.y_m, t.after.heading_rad) for t in turns]
    return Trace(
        world=world,
        bumps=np.array([t.bump for t in turns]),
        places_m=np.array(poses)[:, :2],
        headings_rad=np.array(poses)[:, 2],
        way_m=np.array([t.way_m for t in turns]),
        laps_left=laps[0],
        laps_right=laps[1],
    )


def same(a: Trace, b: Trace) -> bool:
    """Equal to the last bit."""
    return all(
        np.array_equal(getattr(a, name), getattr(b, name))
        for name in (field.name for field in fields(Trace))
    )


@pytest.mark.parametrize("batch", [1, IMAGES_PER_PASS])
@pytest.mark.parametrize("decimals", [1, 7])
def test_robots_side_by_side_drive_as_if_each_were_alone(
    env: CorridorEnv, batch: int, decimals: int
) -> None:
    network = Network(ActorNumerics(batch=batch), decimals)
    poses = start_poses(env.world, env.config.robot.radius_m, STARTS)
    expected = []
    for number, pose in enumerate(poses):
        turns, laps = alone(env, network, number, pose, ACTIONS)
        expected.append(trace_of(env.robot.world.name, pose, turns, laps))
    bumped = [number for number, trace in enumerate(expected) if trace.bumps[:-1].any()]
    assert bumped[-2:] > [0], "there must be recoveries to drive on from"
    assert (network.ties > STARTS) == (decimals == 1)
    found = evaluate(env, greedy(network), STARTS, ACTIONS)
    assert all(map(same, found.traces, expected))
    assert len(found.traces) == STARTS
    assert found.figures == figures_of(env, expected)


def test_all_images_of_a_round_are_predicted_at_once(env: CorridorEnv) -> None:
    network = Network(side_by_side(ActorNumerics()), 7)
    evaluate(env, greedy(network), STARTS, 3)
    assert network.passes == [STARTS] * 3


@pytest.mark.parametrize("actor", [ActorNumerics(threads=2), ActorNumerics(device="cuda")])
def test_only_the_size_of_passes_is_another_for_many_robots(actor: ActorNumerics) -> None:
    many = side_by_side(actor)
    assert many.images_per_pass == IMAGES_PER_PASS
    kept = {"batch": actor.batch, "cuda_batch": actor.cuda_batch}
    assert many.model_copy(update=kept) == actor


def test_all_robots_share_one_scene(env: CorridorEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*given: object) -> None:
        raise AssertionError("another scene is built")

    monkeypatch.setattr(sim, "Scene", refuse)
    assert len(evaluate(env, uniform, 20, 2).traces) == 20
    env.observe()


def test_a_pose_inside_a_wall_is_refused_and_the_scene_stays(env: CorridorEnv) -> None:
    good = start_poses(env.world, env.config.robot.radius_m, 2)
    with pytest.raises(ValueError, match="inside a wall"):
        drive(env, uniform, [*good, Pose(99.0, 99.0, 0.0)], 2)
    assert len(drive(env, uniform, good, 2)) == 2
    assert drive(env, uniform, [], 2) == []


def test_the_planner_leads_every_robot_by_a_plan_of_its_own() -> None:
    with CorridorEnv("plus") as env:
        planned = Planned(env.world, env.config.robot)
        poses = start_poses(env.world, env.config.robot.radius_m, 3)
        found = drive(env, planned, poses, 60)
        assert not any(trace.bumps.any() for trace in found)
        for pose, trace in zip(poses, found, strict=True):
            assert same(trace, drive(env, planned, [pose], 60)[0])
