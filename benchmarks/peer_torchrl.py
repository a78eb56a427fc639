"""torchrl's remote replay buffer in a process of its own, reached through torch's RPC over TCP.

python -m benchmarks.peer_torchrl PORT      serves until the client leaves
"""

from __future__ import annotations

import logging
import subprocess
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict
from torch.distributed import rpc
from torchrl.data import LazyMemmapStorage, RemoteTensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import RandomSampler
from torchrl.data.replay_buffers.writers import RoundRobinWriter

from shared.facts import IMAGE_SHAPE
from shared.messages import Episode
from shared.provenance import ROOT

CLIENT, SERVER = "client", "replay"
THREADS = 4


def joined(name: str, port: int) -> None:
    """Become one of the two processes, connected by TCP: no shared memory."""
    warnings.filterwarnings("ignore", category=UserWarning, module=r"torch\.distributed")
    options = rpc.TensorPipeRpcBackendOptions(
        num_worker_threads=THREADS, init_method=f"tcp://127.0.0.1:{port}", _transports=["uv"]
    )
    rank = (CLIENT, SERVER).index(name)
    rpc.init_rpc(name, rank=rank, world_size=2, rpc_backend_options=options)


def build(folder: str, capacity: int, batch: int) -> RemoteTensorDictReplayBuffer:
    """The buffer of torchrl's own distributed example: images in a memory-mapped file."""
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    return RemoteTensorDictReplayBuffer(
        storage=LazyMemmapStorage(capacity, scratch_dir=folder),
        sampler=RandomSampler(),
        writer=RoundRobinWriter(),
        batch_size=batch,
    )


class Client:
    """What an actor and a learner would ask of the buffer."""

    def __init__(self, folder: Path, capacity: int, batch: int) -> None:
        self._batch = batch
        self._buffer = rpc.remote(SERVER, build, args=(str(folder), capacity, batch))

    def insert(self, episode: TensorDict) -> None:
        """Send samples; they are in the buffer when this returns."""
        extend = RemoteTensorDictReplayBuffer.extend
        rpc.rpc_sync(SERVER, extend, args=(self._buffer, episode))

    def sample(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Images, actions and rewards of a mini-batch."""
        drawn = rpc.rpc_sync(
            SERVER, RemoteTensorDictReplayBuffer.sample, args=(self._buffer, self._batch)
        )
        return drawn["image"].numpy(), drawn["action"].numpy(), drawn["reward"].numpy()


@contextmanager
def connected(folder: Path, port: int, capacity: int, batch: int) -> Iterator[Client]:
    """A client of a server process that lives as long as the block."""
    command = [sys.executable, "-m", "benchmarks.peer_torchrl", str(port)]
    with subprocess.Popen(command, cwd=ROOT):
        joined(CLIENT, port)
        try:
            yield Client(folder, capacity, batch)
        finally:
            rpc.shutdown()


def as_tensors(episode: Episode) -> TensorDict:
    """What torchrl gets of an episode: images, actions and rewards."""
    count = episode.count
    images = np.frombuffer(episode.images, np.uint8).reshape(count, *IMAGE_SHAPE)
    columns = {
        "image": images,
        "action": np.frombuffer(episode.sample_actions, np.uint8),
        "reward": np.frombuffer(episode.sample_rewards, "<f4"),
    }
    tensors = {name: torch.from_numpy(column.copy()) for name, column in columns.items()}
    return TensorDict(tensors, [count])


def main(port: str) -> None:
    """Serve until the client leaves."""
    joined(SERVER, int(port))
    rpc.shutdown()


if __name__ == "__main__":
    main(*sys.argv[1:])
