"""Do environments and recordings work with the programs of others? `make peers-test` runs it.

    python -m tests.peers.trial

Stable-Baselines3's checker, its DQN on one environment and its PPO on vectors of two worlds, in
one process and in one each; Gymnasium's `RecordVideo`; Rerun's reader on a whole recording and on
one that breaks off. Prints a line each.
"""

from __future__ import annotations

import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
from gymnasium.wrappers import RecordVideo
from rerun.chunk import McapReader
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

import experiments.environment
from experiments.environment import CorridorEnv
from services.recorder.recording import Origin, RecordingWriter
from services.recorder.tap import Heard
from services.robot_driver.simulated.world import solids
from shared.codec import encode
from shared.config import ActorNumerics, Config
from shared.keys import OBSERVATION

WORLDS = ("corridor/Plus-v0", "corridor/Minus-v0")
STEPS = 1000


def checked() -> None:
    """The checker neither raises nor warns."""
    for world in WORLDS:
        env = gymnasium.make(world)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env(env.unwrapped)
        env.close()


def dqn() -> None:
    """DQN trains on one environment."""
    env = gymnasium.make(WORLDS[0])
    model = DQN("CnnPolicy", env, buffer_size=STEPS, learning_starts=100, device="cpu", seed=1)
    model.learn(STEPS)
    assert model.num_timesteps >= STEPS
    env.close()


def ppo(vector: type[VecEnv]) -> Callable[[], None]:
    """PPO trains on both worlds beside each other."""

    def train() -> None:
        envs = vector([lambda world=world: gymnasium.make(world) for world in WORLDS])
        model = PPO("CnnPolicy", envs, n_steps=250, batch_size=100, n_epochs=1, device="cpu")
        model.learn(STEPS)
        assert model.num_timesteps >= STEPS
        envs.close()

    return train


def recorded() -> None:
    """An episode becomes an MP4."""
    with tempfile.TemporaryDirectory() as folder:
        env = RecordVideo(
            gymnasium.make(WORLDS[0], render_mode="rgb_array", max_episode_steps=20),
            str(Path(folder) / "videos"),
        )
        env.reset(seed=1)
        while not any(env.step(env.action_space.sample())[2:4]):
            pass
        env.close()
        (video,) = Path(folder).glob("videos/*.mp4")
        assert video.stat().st_size > 1000


def rerun() -> None:
    """Rerun finds every image and pose, and those before the end of a file that breaks off."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.mcap"
        env = CorridorEnv("plus")
        env.reset(seed=1)
        with RecordingWriter(path, Origin(Config(), ActorNumerics()), solids) as writer:
            for number in range(STEPS // 10):
                seen = env.seen
                writer.add(Heard(OBSERVATION, seen.robot, number * 10**8, encode(seen)))
                writer.flush()
                if env.step(np.int64(number % 3))[2]:
                    env.reset()
        env.close()
        assert shown(path) == {
            "Image:buffer": STEPS // 10,
            "InstancePoses3D:translations": STEPS // 10,
        }
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        assert min(shown(path).values()) > STEPS // 30


def shown(path: Path) -> Counter[str]:
    """How many images and poses Rerun finds."""
    found: Counter[str] = Counter()
    for chunk in McapReader(path, recover=True).stream():
        names = chunk.to_record_batch().schema.names
        for what in ("Image:buffer", "InstancePoses3D:translations"):
            found[what] += chunk.num_rows if what in names else 0
    return found


TRIALS = {
    "Stable-Baselines3's checker": checked,
    "DQN": dqn,
    "PPO, one process": ppo(DummyVecEnv),
    "PPO, a process each": ppo(SubprocVecEnv),
    "RecordVideo": recorded,
    "Rerun": rerun,
}


def main() -> int:
    """Try them; returns 0 if all work."""
    gymnasium.register_envs(experiments.environment)
    for name, trial in TRIALS.items():
        start_s = time.monotonic()
        trial()
        print(f"{name}: works, {time.monotonic() - start_s:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
