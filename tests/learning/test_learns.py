"""The robot learns to drive: not a falling loss, but laps."""

from __future__ import annotations

from statistics import mean

import pytest

from experiments.single_process import SingleProcess
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import load_world
from shared.config import Config

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
RANDOM_FITNESS = 12.0
"""Mean actions to a bump of the random policy in Plus (docs/worlds.md)."""


def test_narrow_network_drives_laps_of_plus_within_150_episodes() -> None:
    config = Config.model_validate(
        {
            "network": {"filters": 16},
            "memory": {"capacity": 3000},
            "learning": {"fit_every": 50, "mini_batches_per_episode": 4},
            "episode": {"max_samples": 200, "horizon": 50},
        }
    )
    robot = SimRobot(config.robot, load_world("plus"), config.run.seed)
    loop = SingleProcess(config, robot)
    fitness = []
    for done in loop.run():
        if done.commit.episode:
            fitness.append(done.submitted.fitness)
        if done.commit.episode == 150:
            break
    loop.memory.check_valid()
    robot.close()
    assert mean(fitness[-50:]) > 4 * RANDOM_FITNESS
    assert robot.laps.left + robot.laps.right >= 5
