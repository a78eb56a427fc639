"""Checkpoints: both networks, the optimiser and all counters in one file, replaced atomically.

Random state needs no saving: every draw is a function of seed and position (`shared.rl.draws`).
"""

from __future__ import annotations

import json
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save as save_safetensors

from shared.errors import StateError
from shared.rl.learning import Trainer
from shared.statefile import write_atomically

SCHEMA = 1


def write(path: Path, trainer: Trainer, episode: int, identity: str) -> None:
    """Write the state after `episode`: on disk when this returns."""
    header = {
        "schema": SCHEMA,
        "identity": identity,
        "episode": episode,
        "counters": trainer.counters(),
    }
    tensors = {name: t.cpu().contiguous() for name, t in trainer.tensors().items()}
    write_atomically(path, save_safetensors(tensors, {"state": json.dumps(header)}))


def read(path: Path, trainer: Trainer, identity: str) -> int:
    """Restore the trainer; returns the newest episode done, 0 without a checkpoint.

    Raises StateError when the file is damaged or of another run or network.
    """
    if not path.exists():
        return 0
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads(file.metadata()["state"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if (header["schema"], header["identity"]) != (SCHEMA, identity):
            raise StateError(
                f"{path}: expected a checkpoint of {(SCHEMA, identity)}, "
                f"found {(header['schema'], header['identity'])}"
            )
        trainer.restore(tensors, header["counters"])
        return int(header["episode"])
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise StateError(f"{path}: damaged checkpoint: {error}") from error
