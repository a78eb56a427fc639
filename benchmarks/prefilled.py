"""Runs that begin with a full memory: written to disk the way replay does, then started on."""

from __future__ import annotations

import os
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt

from services.launcher.supervisor import ChildSpec, Supervisor
from services.launcher.up import child_specs
from services.replay.storage import Storage
from shared import settings
from shared.bus import Bus
from shared.config import Config
from shared.errors import BusError, RouterMissing
from shared.facts import ACTION_COUNT, IMAGE_BYTES
from shared.keys import PROGRESS
from shared.messages import Episode, ProgressRequest, RobotProgress
from shared.rl.memory import ReplayMemory
from shared.rl.retention.strategy import Discard
from shared.rl.turn import Maintenance

LIFE = "beec0ffeebee"
EPISODE_SAMPLES = 450
PATIENCE_S = 60.0
ALL = ("router", "replay", "learner", "actor", "driver")
Images = npt.NDArray[np.uint8]


def make_episode(number: int, samples: int, *, fill: bool, images: Images | None = None) -> Episode:
    """An episode of these images; of noise, which no shortcut can shrink, without any."""
    rng = np.random.default_rng(number)
    return Episode(
        robot="bench",
        life=LIFE,
        number=number,
        fill=fill,
        ended="full",
        bump=False,
        weights_version=1,
        fitness=500,
        actions=samples,
        dropped_samples=0,
        dropped_episodes=0,
        worlds=("plus",),
        images=rng.bytes(samples * IMAGE_BYTES) if images is None else images.tobytes(),
        sample_actions=rng.integers(0, ACTION_COUNT, samples, np.uint8).tobytes(),
        sample_rewards=rng.uniform(-0.9, 0.9, samples).astype("<f4").tobytes(),
        sample_steps=np.arange(samples, dtype="<u4").tobytes(),
        sample_episodes=np.full(samples, number, "<u4").tobytes(),
        sample_versions=np.ones(samples, "<u4").tobytes(),
        sample_worlds=bytes(samples),
        sample_by=bytes(samples),
        positions=bytes(12 * samples),
        robot_life=LIFE,
        last_sequence=(number + 1) * samples - 1,
    )


def fill(folder: Path, config: Config, images: Images | None = None) -> int:
    """Write a full memory, of these images over and over or of noise; submissions made."""
    identity = f"{config.run.name}/{config.run.seed}"
    storage = Storage(folder / "replay", config.memory, identity)
    memory, number = ReplayMemory(config.memory.capacity), 0
    while len(memory) < config.memory.capacity:
        some = None if images is None else _in_turn(images, number)
        storage.commit(make_episode(number, EPISODE_SAMPLES, fill=True, images=some))
        pending = storage.pending(number)
        assert pending is not None
        memory.worlds = pending.worlds
        memory.append(pending.rows, pending.images)
        nothing = Discard(memory.capacity)
        storage.apply_turn(pending, memory, Maintenance(nothing, equalised=False))
        number += 1
    storage.close()
    return number


def _in_turn(images: Images, number: int) -> Images:
    return images[(number * EPISODE_SAMPLES + np.arange(EPISODE_SAMPLES)) % len(images)]


@contextmanager
def system(
    config: Config, folder: Path, names: Collection[str] = ALL, robots: int = 1
) -> Iterator[Supervisor]:
    """The processes of a run with these names, and drivers for further robots."""
    stored = settings.claim(folder, config)
    specs = child_specs(config, stored, folder, config.bus.endpoint)
    specs += [another_driver(specs, f"robotino{i}") for i in range(2, robots + 1)]
    (folder / "logs").mkdir(exist_ok=True)
    wanted = [spec for spec in specs if spec.name.partition("-")[0] in names]
    with Supervisor(wanted, folder / "logs", dict(os.environ), []) as supervisor:
        yield supervisor


def another_driver(specs: list[ChildSpec], robot: str) -> ChildSpec:
    """A further simulated robot of the same run."""
    driver = next(spec for spec in specs if spec.name == "driver")
    command = (*driver.command, f"--set=robot.id={robot}")
    return ChildSpec(f"driver-{robot}", command, driver.stage)


def bus(config: Config, *, shared_memory: bool = False) -> Bus:
    """A client, as soon as the router answers and replay serves."""
    chosen = config.bus.model_copy(update={"shared_memory": shared_memory})
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            client = Bus(chosen, config.run.name)
            client.request(PROGRESS, ProgressRequest(robot="bench"), RobotProgress, ident="bench")
            return client
        except BusError as error:
            if not isinstance(error, RouterMissing):
                client.close()
            if time.monotonic() > deadline_s:
                raise
