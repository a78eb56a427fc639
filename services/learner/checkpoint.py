"""Checkpoints: both networks, the optimiser and all counters in one file, replaced atomically.

Random state needs no saving: every draw is a function of seed and position (`shared.rl.draws`).
The checkpoint before the newest is kept beside it, for the case that the newest cannot be read.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as save_safetensors

from services.learner.history import Place
from shared.errors import StateError
from shared.rl.learning import Trainer
from shared.statefile import set_aside, write_atomically

SCHEMA = 1
PREVIOUS = ".previous"


class Damaged(StateError):
    """A checkpoint that cannot be read."""


def write(
    path: Path, trainer: Trainer, episode: int, identity: str, lineage: str = Place.lineage
) -> None:
    """Write the state after `episode`: on disk when this returns.

    lineage: of the memory as of that episode. Raises FloatingPointError and writes nothing when a
    number is not finite.
    """
    header = {
        "schema": SCHEMA,
        "identity": identity,
        "episode": episode,
        "lineage": lineage,
        "counters": trainer.counters(),
    }
    tensors = {name: t.cpu().contiguous() for name, t in trainer.tensors().items()}
    if odd := _not_finite(tensors):
        raise FloatingPointError(f"{odd} is not finite")
    data = save_safetensors(tensors, {"state": json.dumps(header)})
    if path.exists():
        previous = path.with_name(path.name + PREVIOUS)
        previous.unlink(missing_ok=True)
        os.link(path, previous)
    write_atomically(path, data)


def read(path: Path, trainer: Trainer, identity: str) -> Place:
    """Restore the trainer; returns the newest turn done, episode 0 without a checkpoint.

    Raises Damaged when the file cannot be read, StateError when it is of another run.
    """
    if not path.exists():
        return Place()
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads(file.metadata()["state"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if (header["schema"], header["identity"]) != (SCHEMA, identity):
            raise StateError(
                f"{path}: expected a checkpoint of {(SCHEMA, identity)}, "
                f"found {(header['schema'], header['identity'])}"
            )
        if odd := _not_finite(tensors):
            raise ValueError(f"{odd} is not finite")
        trainer.restore(tensors, header["counters"])
        return Place(int(header["episode"]), str(header.get("lineage", "")))
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise Damaged(f"{path}: damaged checkpoint: {error}") from error


def take_up(path: Path, trainer: Trainer, identity: str) -> Place:
    """Read the learner's own checkpoint. One that cannot be read is set aside.

    Raises StateError as `read` does. After a damaged one the next start goes on from the one
    before, if there is one.
    """
    try:
        return read(path, trainer, identity)
    except Damaged as error:
        told = f"{error}; it lies at {set_aside(path)} now"
        previous = path.with_name(path.name + PREVIOUS)
        if not previous.exists():
            raise StateError(f"{told}, and the next start begins with new networks") from error
        previous.rename(path)
        raise StateError(f"{told}, and the next start goes on from the one before") from error


def _not_finite(tensors: dict[str, torch.Tensor]) -> str:
    """Name of a tensor with a number that is not finite; empty if there is none."""
    finite = ((name, bool(torch.isfinite(t).all())) for name, t in tensors.items())
    return next((name for name, all_are in finite if not all_are), "")
