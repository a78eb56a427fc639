"""Checkpoints: both networks, the optimiser and all counters in one file, replaced atomically.

Each state goes to one of two files in turn that are not brought to disk: it survives a kill of the
process and costs no disk. `sync` makes the newest one the checkpoint; the one before is kept beside
it. After a crash of the machine the others do not count.
"""

import json
import os
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as save_safetensors

from services.learner.history import Place
from shared.config import Config
from shared.errors import StateError
from shared.provenance import BUNDLE, bundle
from shared.rl.learning import Trainer
from shared.statefile import needing_room, set_aside
from shared.statefile import sync as sync_folder

SCHEMA = 1
PREVIOUS = ".previous"
UNSYNCED = (".unsynced-0", ".unsynced-1")


class Damaged(StateError):
    """A checkpoint that cannot be read."""


def write(
    path: Path, trainer: Trainer, episode: int, identity: str, lineage: str = Place.lineage,
    config: Config | None = None,
) -> None:  # fmt: skip
    """Write the state after `episode`: on disk when this returns. Raises like `keep`."""
    _promote(path, keep(path, trainer, episode, identity, lineage, config))


def keep(
    path: Path, trainer: Trainer, episode: int, identity: str, lineage: str = Place.lineage,
    config: Config | None = None,
) -> Path:  # fmt: skip
    """Write the state after `episode`, and return where: it survives a kill, not a power cut.

    lineage: of the memory as of that episode; config: what others must know who use the network.
    Raises DiskFull, and FloatingPointError when a number is not finite; nothing is written then.
    """
    header = {
        "schema": SCHEMA,
        "identity": identity,
        "episode": episode,
        "lineage": lineage,
        "counters": trainer.counters(),
        "boot": _boot(),
    }
    if config is not None:
        made = bundle(config, episode=episode, train_steps=trainer.train_steps)
        header[BUNDLE] = made.model_dump(mode="json")
    tensors = {name: t.cpu().contiguous() for name, t in trainer.tensors().items()}
    if odd := _not_finite(tensors):
        raise FloatingPointError(f"{odd} is not finite")
    data = save_safetensors(tensors, {"state": json.dumps(header)})
    own = beside(path, UNSYNCED[episode % 2])
    with needing_room(path):
        own.parent.mkdir(parents=True, exist_ok=True)
        own.unlink(missing_ok=True)
        own.write_bytes(data)
    return own


def sync(path: Path) -> None:
    """Bring the newest state to disk, if it is newer than the checkpoint. Raises DiskFull."""
    newest = max((beside(path, name) for name in UNSYNCED), key=_age)
    if _age(newest) > _age(path):
        _promote(path, newest)


def _promote(path: Path, newest: Path) -> None:
    """Make a state the checkpoint; the one before is kept, the others are not needed."""
    with needing_room(path), newest.open("rb") as file:
        os.fsync(file.fileno())
    if path.exists():
        beside(path, PREVIOUS).unlink(missing_ok=True)
        os.link(path, beside(path, PREVIOUS))
    newest.replace(path)
    for name in UNSYNCED:
        beside(path, name).unlink(missing_ok=True)
    sync_folder(path.parent)


def read(path: Path, trainer: Trainer, identity: str) -> Place:
    """Restore the trainer; returns the newest turn done. Raises Damaged or StateError."""
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
    """Read the learner's own newest state. Raises StateError as `read` does.

    A damaged one is set aside; the next start goes on from the one before, if there is one.
    """
    if _age(path) >= 0:
        sync(path)
    try:
        return read(path, trainer, identity)
    except Damaged as error:
        told = f"{error}; it lies at {set_aside(path)} now"
        previous = beside(path, PREVIOUS)
        if not previous.exists():
            raise StateError(f"{told}, and the next start begins with new networks") from error
        previous.rename(path)
        raise StateError(f"{told}, and the next start goes on from the one before") from error


def beside(path: Path, name: str) -> Path:
    """One of the files beside a checkpoint."""
    return path.with_name(path.name + name)


def _boot() -> str:
    """Which start of the machine this is; empty where nobody tells."""
    told = Path("/proc/sys/kernel/random/boot_id")
    return told.read_text().strip() if told.exists() else ""


def _age(path: Path) -> int:
    """The episode of a state; -1 if it cannot be read, or may not have come to disk as it is."""
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads(file.metadata()["state"])
        counts = path.suffix == ".safetensors" or header["boot"] == _boot()
        return int(header["episode"]) if counts else -1
    except (OSError, SafetensorError, KeyError, TypeError, ValueError):
        return -1


def _not_finite(tensors: dict[str, torch.Tensor]) -> str:
    """Name of a tensor with a number that is not finite; empty if there is none."""
    finite = ((name, bool(torch.isfinite(t).all())) for name, t in tensors.items())
    return next((name for name, all_are in finite if not all_are), "")
