"""Real images and weights to measure with: random drives through Plus and a network fitted to them.

Both are made once and kept in `benchmarks/.cache`, which may be deleted at any time.
"""

from __future__ import annotations

import functools
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.frame import Mode
from experiments.single_process import SingleProcess
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import load_world
from shared.config import Config, LearnerNumerics, LearningConfig, NetworkConfig
from shared.rl.learning import Trainer
from shared.rl.memory import MIRROR, SampleStore
from shared.rl.network import initialised, to_bytes

CACHE = Path(__file__).parent / ".cache"
SEED = 1
Images = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Sizes:
    """How much of everything a mode takes."""

    filters: int
    frames: int
    steps: int
    """Training steps of the quickly trained network."""


SIZES: dict[Mode, Sizes] = {
    "check": Sizes(filters=4, frames=160, steps=2),
    "short": Sizes(filters=64, frames=4000, steps=120),
    "full": Sizes(filters=64, frames=45_000, steps=400),
}


def network_config(mode: Mode) -> NetworkConfig:
    """The network of the thesis; a narrow one where only the running is checked."""
    return NetworkConfig(filters=SIZES[mode].filters)


@functools.cache
def samples(mode: Mode) -> SampleStore:
    """Images, actions and rewards of random drives (seeded), oldest first."""
    count = SIZES[mode].frames
    path = CACHE / f"frames-{count}.npz"
    if path.exists():
        with np.load(path) as stored:
            return _store(stored["images"], stored["actions"], stored["rewards"])
    images, actions, rewards = _driven(count)
    if mode != "check":
        CACHE.mkdir(exist_ok=True)
        np.savez(path, images=images, actions=actions, rewards=rewards)
    return _store(images, actions, rewards)


def images(mode: Mode, count: int) -> Images:
    """The first images of the drives, or all of them over again where there are fewer."""
    store = samples(mode)
    return store.images(np.arange(count, dtype=np.int64) % len(store))


@functools.cache
def trained_weights(mode: Mode) -> bytes:
    """Weights after some training steps on the drives, as safetensors bytes."""
    sizes = SIZES[mode]
    path = CACHE / f"weights-{sizes.frames}-{sizes.steps}.safetensors"
    if path.exists():
        return path.read_bytes()
    store = samples(mode)
    numerics = LearnerNumerics(precision="bfloat16", threads=min(2, len(os.sched_getaffinity(0))))
    trainer = Trainer(network_config(mode), LearningConfig(), numerics, SEED)
    draw = np.random.default_rng(SEED)
    for _ in range(sizes.steps):
        trainer.step(store, draw.choice(len(store), min(128, len(store)), replace=False))
    data = to_bytes(trainer.train_network)
    if mode != "check":
        CACHE.mkdir(exist_ok=True)
        path.write_bytes(data)
    return data


def untrained_weights(mode: Mode) -> bytes:
    """The initial weights of a run, as safetensors bytes."""
    return to_bytes(initialised(network_config(mode), SEED))


def _driven(count: int) -> tuple[Images, npt.NDArray[np.uint8], npt.NDArray[np.float32]]:
    """Let the loop fill its memory by random actions; a narrow network predicts meanwhile."""
    spare = 1000  # the fill ends before the memory is full to the last sample
    config = Config.model_validate(
        {
            "network": {"filters": 4},
            "memory": {"capacity": count + spare, "fill": "random"},
            "run": {"seed": SEED},
        }
    )
    robot = SimRobot(config.robot, load_world(config.robot.world), config.run.seed)
    loop = SingleProcess(config, robot)
    for _ in loop.run():
        if len(loop.memory) >= count:
            break
    robot.close()
    rows = loop.memory.rows[:count]
    return loop.memory.images(np.arange(count)), rows["action"].copy(), rows["reward"].copy()


def _store(
    images: Images, actions: npt.NDArray[np.uint8], rewards: npt.NDArray[np.float32]
) -> SampleStore:
    rows = np.zeros(len(images), MIRROR)
    rows["id"] = np.arange(1, len(images) + 1)
    rows["action"], rows["reward"] = actions, rewards
    store = SampleStore()
    store.append(rows, images)
    return store
