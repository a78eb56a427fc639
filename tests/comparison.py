"""What must be equal between the single-process loop and the four services."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open

from experiments.single_process import SingleProcess
from services.replay.storage import Storage
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import load_world
from shared.config import Config
from shared.messages import WorldChange
from shared.rl.memory import ReplayMemory


@dataclass
class Outcome:
    """Everything a run produced, up to and including its last episode."""

    digests: list[tuple[int, str]]
    """Of every submission: episode number and what was seen, done and rewarded."""
    memory: ReplayMemory
    kept: dict[str, int]
    tensors: dict[str, torch.Tensor]
    """Both networks and the optimiser."""
    version: int


def single_process(config: Config, episodes: int, changes: Sequence[WorldChange] = ()) -> Outcome:
    """Run the reference loop, with changes of the world on the way."""
    robot = SimRobot(config.robot, load_world(config.robot.world), config.run.seed)
    loop = SingleProcess(config, robot)
    for change in changes:
        assert loop.env.driver.change(change).accepted
    digests = []
    for done in loop.run():
        digests.append((done.commit.episode, done.submitted.digest))
        if done.commit.episode == episodes:
            break
    robot.close()
    trainer = loop.trainer
    tensors = {name: t.clone() for name, t in trainer.tensors().items()}
    return Outcome(digests, loop.memory, loop.memory.kept, tensors, trainer.version)


def distributed(config: Config, folder: Path) -> Outcome:
    """Read what the services left in a run folder."""
    storage = Storage(folder / "replay", config.memory, f"{config.run.name}/{config.run.seed}")
    digests = [(int(r["commit"]["episode"]), str(r["digest"])) for r in storage.records()]
    memory, position = storage.load(), storage.position()
    storage.close()
    path = folder / "learner" / "checkpoint.safetensors"
    with safe_open(path, framework="pt") as file:
        import json

        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        counters = json.loads(file.metadata()["state"])["counters"]
    return Outcome(digests, memory, position.kept, tensors, counters["version"])


def assert_equal(one: Outcome, other: Outcome) -> None:
    """Bit for bit."""
    assert one.digests == other.digests
    assert one.kept == other.kept
    assert one.memory.capacity == other.memory.capacity
    assert one.version == other.version
    one.memory.check_valid()
    other.memory.check_valid()
    assert len(one.memory) == len(other.memory)
    for name in one.memory.rows.dtype.names or ():
        if name != "slot":
            np.testing.assert_array_equal(
                one.memory.rows[name], other.memory.rows[name], err_msg=name
            )
    everything = np.arange(len(one.memory))
    np.testing.assert_array_equal(one.memory.images(everything), other.memory.images(everything))
    assert one.tensors.keys() == other.tensors.keys()
    for name, tensor in one.tensors.items():
        assert torch.equal(tensor, other.tensors[name]), name
