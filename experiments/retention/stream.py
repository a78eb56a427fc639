"""Streams: everything a robot saw and did in a run, and the networks it had, on disk.

    samples.bin            `SAMPLES`, one for each sample in order of insertion
    images.bin             uint8 [50, 75] each, in the same order
    turns.bin              `TURNS`, one for each submission
    worlds.json            the names that the column `world` points into
    weights/<version>.safetensors

A run that is stopped and goes on continues its stream: what was written after its last snapshot is
cut off and comes again.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from experiments.runs.totals import Watch
from experiments.single_process import SingleProcess, TurnDone
from shared.errors import StateError
from shared.facts import IMAGE_BYTES, IMAGE_SHAPE
from shared.rl.memory import SAMPLE, Images
from shared.rl.network import to_bytes
from shared.rl.retention.strategy import columns
from shared.rl.schedule import Moment
from shared.rl.turn import sample_rows
from shared.statefile import write_atomically

_OWN = {"slot", *(column[0] for column in columns())}
SAMPLES = np.dtype([(n, SAMPLE[n]) for n in SAMPLE.names or () if n not in _OWN])
"""What came with a sample: all columns but those of a memory and of its strategy."""
TURNS = np.dtype(
    [
        ("commit", "<u4"),
        ("episode", "<u4"),  # 0 while the memory was filled
        ("next_id", "<u8"),  # insertion number after the last sample of this submission
        ("total_actions", "<u8"),
        ("actions", "<u4"),
        ("version", "<u4"),  # of the network in force
    ]
)


class Recorder(Watch):
    """Writes the stream of a run into a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        (folder / "weights").mkdir(parents=True, exist_ok=True)

    def begin(self, loop: SingleProcess) -> None:
        """Cut off what was written after the loop's state, and keep its network."""
        samples = loop.counters.next_id - 1
        for name, size, count in (
            ("samples.bin", SAMPLES.itemsize, samples),
            ("images.bin", IMAGE_BYTES, samples),
            ("turns.bin", TURNS.itemsize, loop.counters.commit),
        ):
            with (self._folder / name).open("ab") as file:
                if file.tell() < size * count:
                    raise StateError(f"{self._folder / name}: expected {count} entries, found less")
                file.truncate(size * count)
        self._keep_weights(loop)

    def turn(self, loop: SingleProcess, done: TurnDone) -> None:
        """Write what a turn brought."""
        episode, commit = done.submitted, done.commit
        rows, images = sample_rows(episode, loop.memory.worlds, commit)
        turn = np.zeros(1, TURNS)
        turn["commit"], turn["episode"] = commit.commit, commit.episode
        turn["next_id"] = commit.first_id + commit.stored
        turn["total_actions"], turn["actions"] = loop.counters.actions, episode.actions
        turn["version"] = episode.weights_version
        own = np.zeros(len(rows), SAMPLES)
        for name in SAMPLES.names or ():
            own[name] = rows[name]
        parts = {"samples.bin": own, "images.bin": images, "turns.bin": turn}
        for name, array in parts.items():
            with (self._folder / name).open("ab") as file:
                file.write(array.tobytes())
        write_atomically(self._folder / "worlds.json", json.dumps(loop.memory.worlds).encode())
        if done.target_changed:
            self._keep_weights(loop)

    def _keep_weights(self, loop: SingleProcess) -> None:
        path = weights_path(self._folder, loop.trainer.version)
        write_atomically(path, to_bytes(loop.trainer.target_network))


@dataclass(frozen=True)
class Turn:
    """One submission of a stream."""

    now: Moment
    version: int
    rows: npt.NDArray[np.void]
    """`SAMPLE` [n], as they are appended to a memory."""
    images: Images


class Stream:
    """A recorded stream. Images stay on disk until they are looked at."""

    def __init__(self, folder: Path) -> None:
        """Raises StateError when the files do not belong together."""
        self.folder = folder
        try:
            self.samples = np.fromfile(folder / "samples.bin", SAMPLES)
            self._turns = np.fromfile(folder / "turns.bin", TURNS)
            self.worlds: list[str] = json.loads((folder / "worlds.json").read_bytes())
            count = len(self.samples)
            self.images: Any = np.memmap(folder / "images.bin", np.uint8, "r")
            self.images = self.images.reshape(count, *IMAGE_SHAPE)
        except (OSError, ValueError) as error:
            raise StateError(f"{folder}: damaged stream: {error}") from error
        if not len(self._turns) or self._turns["next_id"][-1] != count + 1:
            raise StateError(f"{folder}: damaged stream: samples and turns differ")

    def turns(self) -> Iterator[Turn]:
        """Yield the submissions in order."""
        start = 0
        for turn in self._turns:
            end = int(turn["next_id"]) - 1
            rows = np.zeros(end - start, SAMPLE)
            for name in SAMPLES.names or ():
                rows[name] = self.samples[name][start:end]
            now = Moment(int(turn["episode"]), int(turn["total_actions"]), int(turn["actions"]))
            yield Turn(now, int(turn["version"]), rows, np.array(self.images[start:end]))
            start = end

    def weights(self, version: int) -> bytes:
        """Return the network of a version as safetensors bytes. Raises OSError."""
        return weights_path(self.folder, version).read_bytes()


def weights_path(folder: Path, version: int) -> Path:
    """Where the network of a version lies."""
    return folder / "weights" / f"{version}.safetensors"
