"""The whole state of a single-process run on disk: a run goes on from it bit for bit (A46)."""

import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from experiments.single_process import SingleProcess
from services.learner import checkpoint
from services.replay.numbering import Counters
from shared.errors import StateError
from shared.rl.memory import ReplayMemory
from shared.statefile import write_atomically

CHECKPOINT, MEMORY, STATE = "checkpoint.safetensors", "memory.npz", "state.msgpack"
SCHEMA = 2
END = "state-end"
"""Name of the last snapshot of a run. Those on the way are `state-<turn>`."""


def save(folder: Path, loop: SingleProcess, extra: dict[str, Any]) -> None:
    """Write the state after a turn. `extra`: plain values of whoever runs the loop.

    The state file comes last: a folder without it is not a snapshot.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    path, episode = folder / CHECKPOINT, loop.counters.episode
    checkpoint.write(path, loop.trainer, episode, _identity(loop), config=loop.config)
    memory = loop.memory
    with (folder / MEMORY).open("wb") as file:
        np.savez(
            file,
            rows=memory.rows,
            images=memory.images(np.arange(len(memory))),
            worlds=np.frombuffer(json.dumps(memory.worlds).encode(), np.uint8),
        )
    state = {
        "schema": SCHEMA,
        "counters": asdict(loop.counters),
        "capacity": memory.capacity,
        "kept": memory.kept,
        "actor": loop.actor.state(),
        "driver": loop.env.driver.saved(),
        "extra": extra,
    }
    write_atomically(folder / STATE, msgpack.packb(state))


def replace(run: Path, name: str, loop: SingleProcess, extra: dict[str, Any]) -> None:
    """Save the state into the folder of a run, and delete its older snapshots."""
    save(run / name, loop, extra)
    for old in run.glob("state-[0-9]*"):
        if old.name != name:
            shutil.rmtree(old)


def newest(run: Path) -> Path | None:
    """The last snapshot in the folder of a run, if there is one."""
    if exists(run / END):
        return run / END
    own = [path for path in run.glob("state-[0-9]*") if exists(path)]
    return max(own, key=lambda path: int(path.name.removeprefix("state-")), default=None)


def exists(folder: Path) -> bool:
    """Whether a snapshot lies there, complete."""
    return (folder / STATE).is_file()


def restore(folder: Path, loop: SingleProcess) -> dict[str, Any]:
    """Bring a new loop to the saved state; returns `extra`.

    Raises StateError: the snapshot is damaged, or of another network or seed.
    """
    episode = checkpoint.read(folder / CHECKPOINT, loop.trainer, _identity(loop)).episode
    try:
        state = msgpack.unpackb((folder / STATE).read_bytes())
        if state["schema"] != SCHEMA:
            raise ValueError(f"expected schema {SCHEMA}, found {state['schema']}")
        loop.counters = Counters.from_dict(state["counters"])
        if loop.counters.episode != episode:
            raise ValueError(f"episode {loop.counters.episode}, but the checkpoint has {episode}")
        loop.memory = _memory(folder / MEMORY, int(state["capacity"]))
        loop.memory.kept = {str(name): int(value) for name, value in state["kept"].items()}
        loop.env.driver.restore(state["driver"])
        loop.actor.restore(state["actor"])
        extra = state["extra"]
    except (OSError, KeyError, TypeError, ValueError, msgpack.UnpackException) as error:
        raise StateError(f"{folder}: damaged snapshot: {error}") from error
    loop.publish()
    return dict(extra)


def _memory(path: Path, capacity: int) -> ReplayMemory:
    """A replay memory from its file. Raises ValueError when it is not a valid one."""
    memory = ReplayMemory(capacity)
    with np.load(path, allow_pickle=False) as stored:
        memory.worlds = [str(name) for name in json.loads(stored["worlds"].tobytes())]
        rows = stored["rows"]
        if rows.dtype != memory.rows.dtype:
            raise ValueError(f"{path}: rows of another layout")
        memory.append(rows, stored["images"])
    memory.check_valid()
    return memory


def _identity(loop: SingleProcess) -> str:
    """Identity of a chain of experiments: its seed alone, because the name changes in it."""
    return f"experiment/{loop.config.run.seed}"
