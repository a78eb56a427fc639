"""The replay memory on disk (LMDB): what is acknowledged survives kill -9, exactly once.

Images are written once and never changed; what changes lies beside them. Tables:

meta      counters, change number, processed commit, capacity, what retention keeps, run
commits   commit number -> record of the submission (provenance, metrics)
identity  robot, life, number -> commit number: the deduplication
images    insertion number -> bytes of the image
samples   insertion number -> row (reward as inserted)
lives     robot, driver life -> first and last sequence of spans of actions that are settled
dead      insertion number -> change number of its discard; kept until the feed forgets the change
columns   "rewards": all rewards after the newest equalisation; "marks": those of retention;
          "removed": the marks of what the newest discard removed
changes   change number -> kind, ids, lineage of the memory before: the feed
turns     global episode number -> what the learner needs to know

One write transaction commits an episode, another one applies a whole turn: a kill at any moment
leaves one of the two states, and the turn is done again from the first.
"""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import lmdb
import msgpack
import numpy as np
import numpy.typing as npt

from services.replay.footprint import Mapping
from services.replay.numbering import Counters
from shared.config import MemoryConfig
from shared.errors import ConfigError, DiskFull, StateError
from shared.facts import IMAGE_SHAPE
from shared.messages import NO_LINEAGE
from shared.rl.memory import PART, SAMPLE, ReplayMemory
from shared.rl.retention.strategy import columns
from shared.rl.turn import Commit

SCHEMA = 7
MAP_BYTES = 1 << 38
"""Largest size of the file; only what is used exists."""
REWARDS = np.dtype([("id", "<u8"), ("reward", "<f4")])
MARKS = np.dtype([("id", "<u8"), *columns()])
TABLES = (
    *("meta", "commits", "identity", "lives", "images", "samples"),
    *("dead", "columns", "changes", "turns"),
)
LEAST_FREE_BYTES = 1 << 20
"""LMDB fails in several ways where the disk has less room."""
Txn = Any


def key_of(number: int) -> bytes:
    """A number as key: big endian, so that keys sort like numbers."""
    return number.to_bytes(8, "big")


def number_of(key: bytes) -> int:
    """The number behind a key."""
    return int.from_bytes(key, "big")


def pack(value: Any) -> bytes:
    """Plain values as bytes."""
    return bytes(msgpack.packb(value))


def unpack(data: bytes | None) -> Any:
    """What `pack` packed. Raises StateError when the entry is not there."""
    if data is None:
        raise StateError("replay memory on disk: an entry that must exist is missing")
    return msgpack.unpackb(data, strict_map_key=False)


@dataclass(frozen=True)
class Position:
    """How far the memory on disk has come."""

    change: int
    """Newest change number n."""
    processed: int
    """Newest commit whose turn is applied."""
    turn: int
    """Newest counted episode whose turn is applied."""
    turn_change: int
    capacity: int
    """N in force: it may have grown (A44)."""
    kept: dict[str, int] = field(default_factory=dict)
    """What strategies of retention keep from one discard to the next."""
    lineage: str = NO_LINEAGE
    """The lineage that the memory had at `change`."""
    turn_lineage: str = NO_LINEAGE
    """The lineage that it had at `turn_change`."""


class Tables:
    """The open files, and what reading and writing within a transaction share."""

    def __init__(self, folder: Path, *, readonly: bool = False) -> None:
        """Open, or create what is not there; readonly: beside the process that writes, if any.

        Raises ConfigError when the files cannot be mapped, StateError when there are none to read.
        """
        self._folder = folder
        try:
            if not readonly:
                folder.mkdir(parents=True, exist_ok=True)
            self.env = lmdb.open(
                str(folder),
                map_size=MAP_BYTES,
                max_dbs=len(TABLES),
                max_readers=64,
                readonly=readonly,
                lock=not readonly or os.access(folder, os.W_OK),
            )
            self.db = {name: self.env.open_db(name.encode()) for name in TABLES}
        except (MemoryError, lmdb.MemoryError) as error:
            raise ConfigError(
                f"{folder}: expected {MAP_BYTES >> 30} GB of address space for the replay memory, "
                "which takes no memory: allow it with `ulimit -v unlimited`"
            ) from error
        except lmdb.Error as error:
            if not readonly:
                raise
            raise StateError(f"{folder}: expected a replay memory, found none: {error}") from error
        self._mapping = Mapping(folder / "data.mdb")

    def belong_to(self, config: MemoryConfig, identity: str) -> None:
        """Begin a memory in new files. Raises StateError when they are of another run or schema."""
        with self.writing() as txn:
            known = self.meta(txn, "identity")
            if known is None:
                self.put_meta(txn, "identity", [SCHEMA, identity])
                self.put_meta(txn, "counters", asdict(Counters()))
                start = Position(0, 0, 0, 0, config.capacity)
                self.put_meta(txn, "position", asdict(start))
                self.put_meta(txn, "worlds", [])
            elif list(known) != [SCHEMA, identity]:
                raise StateError(
                    f"{self._folder}: expected a replay memory of schema and run "
                    f"{[SCHEMA, identity]}, found {list(known)}: choose another run folder"
                )

    @contextmanager
    def writing(self) -> Iterator[Txn]:
        """A write transaction, on disk at its end. Raises DiskFull: then all is as before."""
        try:
            with self.env.begin(write=True) as txn:
                yield txn
        except lmdb.Error as error:
            if shutil.disk_usage(self._folder).free >= LEAST_FREE_BYTES:
                raise
            raise DiskFull(f"disk full: {self._folder}: {error}") from error

    def position(self, txn: Txn) -> Position:
        """Return how far the turns have come."""
        return Position(**self.meta(txn, "position"))

    def meta(self, txn: Txn, name: str) -> Any:
        """Return one of the values in `meta`; None if it is not there."""
        data = txn.get(name.encode(), db=self.db["meta"])
        return None if data is None else unpack(data)

    def put_meta(self, txn: Txn, name: str, value: Any) -> None:
        """Write one of the values in `meta`."""
        txn.put(name.encode(), pack(value), db=self.db["meta"])

    def alive(self, txn: Txn) -> list[int]:
        """Return the insertion numbers of all samples in memory at the newest turn."""
        processed = self.position(txn).processed
        data = txn.get(key_of(processed), db=self.db["commits"])
        if data is None:
            return []
        commit = Commit(**unpack(data)["commit"])
        end = commit.first_id + commit.stored
        with txn.cursor(self.db["dead"]) as cursor:
            dead = {number_of(key) for key in cursor.iternext(values=False)}
        with txn.cursor(self.db["samples"]) as cursor:
            ids = [number_of(key) for key in cursor.iternext(values=False)]
        return [i for i in ids if i < end and i not in dead]

    def rows(self, txn: Txn, ids: list[int]) -> tuple[npt.NDArray[np.void], npt.NDArray[np.uint8]]:
        """Return rows, rewards as inserted, and images. Raises StateError if one is missing."""
        keys = [key_of(i) for i in ids]
        parts: dict[str, bytes] = {}
        for table in ("samples", "images"):
            with txn.cursor(self.db[table]) as cursor:
                found = cursor.getmulti(keys)
            if len(found) != len(keys):
                raise StateError(f"replay {table}: {len(keys) - len(found)} of {len(keys)} missing")
            parts[table] = b"".join(value for _, value in found)
        self._mapping.looked_at(len(ids))  # an image takes a page
        rows = np.frombuffer(parts["samples"], SAMPLE).copy()
        images = np.frombuffer(parts["images"], np.uint8).reshape(len(ids), *IMAGE_SHAPE)
        return rows, images

    def column(self, txn: Txn, name: str, dtype: np.dtype[np.void]) -> npt.NDArray[np.void]:
        """Return a whole column; empty while there is none."""
        return np.frombuffer(txn.get(name.encode(), db=self.db["columns"]) or b"", dtype)

    def overlay_rewards(self, txn: Txn, rows: npt.NDArray[np.void]) -> None:
        """Replace rewards as inserted by those of the newest equalisation."""
        column = self.column(txn, "rewards", REWARDS)
        known, where = match(rows["id"], column["id"])
        rows["reward"][known] = column["reward"][where]

    def update(self, memory: ReplayMemory) -> Position:
        """Make a memory what it was at the newest applied turn; what it has of that is kept."""
        with self.env.begin() as txn:
            position = self.position(txn)
            memory.set_capacity(position.capacity)
            memory.kept = position.kept
            memory.worlds = list(self.meta(txn, "worlds"))
            alive = np.array(self.alive(txn), np.uint64)
            memory.remove(memory.ids[~np.isin(memory.ids, alive)])
            new = [int(i) for i in alive[~np.isin(alive, memory.ids)]]
            for start in range(0, len(new), PART):
                memory.append(*self.rows(txn, new[start : start + PART]))
            self.overlay_rewards(txn, memory.rows)
            marks = self.column(txn, "marks", MARKS)
        known, where = match(memory.ids, marks["id"])
        for name, *_ in columns():
            memory.rows[name][known] = marks[name][where]
        return position


def match(
    ids: npt.NDArray[np.uint64], known: npt.NDArray[np.uint64]
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.int64]]:
    """Which of `ids` are in the ascending `known`, and where."""
    if not len(known):
        return np.zeros(len(ids), np.bool_), np.zeros(0, np.int64)
    where = np.minimum(np.searchsorted(known, ids), len(known) - 1)
    found = known[where] == ids
    return found, where[found]
