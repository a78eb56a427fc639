"""The replay memory on disk (LMDB): what is acknowledged survives kill -9, exactly once.

Images are written once and never changed; what changes lies beside them. Tables:

meta      counters, change number, processed commit, threshold, identity of the run
commits   commit number -> record of the submission (provenance, metrics)
identity  robot, life, number -> commit number: the deduplication
images    insertion number -> 3750 bytes
samples   insertion number -> row (reward as inserted)
dead      insertion number -> change number of its discard; kept until the feed forgets the change
columns   "rewards": all rewards after the newest equalisation; "marks": descriptors and marks
changes   change number -> kind and ids: the feed
turns     global episode number -> what the learner needs to know

One write transaction commits an episode, another one applies a whole turn: a kill at any moment
leaves one of the two states, and the turn is done again from the first.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import lmdb
import msgpack
import numpy as np
import numpy.typing as npt

from services.replay import numbering
from services.replay.numbering import Commit, Counters
from shared.config import MemoryConfig
from shared.errors import StateError
from shared.messages import IMAGE_BYTES, IMAGE_SHAPE, Change, Episode, FeedEnd, Turn
from shared.rl.memory import SAMPLE, ReplayMemory
from shared.rl.turn import Maintenance, sample_rows

SCHEMA = 1
MAP_BYTES = 1 << 38
"""Largest size of the file; only what is used exists."""
CHANGES_KEPT = 512
PART_ROWS = 256
"""Rows of one reply: about 1 MB."""
REWARDS = np.dtype([("id", "<u8"), ("reward", "<f4")])
MARKS = np.dtype(
    [(name, *SAMPLE.fields[name][:1]) for name in ("id", "descriptor", "described_by")]  # type: ignore[index]
    + [("candidate", "?"), ("forced", "?"), ("marked_by", "<u4")]
)
TABLES = ("meta", "commits", "identity", "images", "samples", "dead", "columns", "changes", "turns")
Txn = Any


def _key(number: int) -> bytes:
    return number.to_bytes(8, "big")


def _number(key: bytes) -> int:
    return int.from_bytes(key, "big")


def _pack(value: Any) -> bytes:
    return bytes(msgpack.packb(value))


def _unpack(data: bytes | None) -> Any:
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
    threshold_percent: int


@dataclass(frozen=True)
class Accepted:
    """Result of a submission."""

    commit: Commit
    counters: Counters
    duplicate: bool


class Storage:
    """All access to the files. Writing methods may be called from two threads: LMDB serialises."""

    def __init__(self, folder: Path, config: MemoryConfig, identity: str) -> None:
        """Open or create. Raises StateError when the files belong to another run or schema."""
        folder.mkdir(parents=True, exist_ok=True)
        self._config = config
        self._env = lmdb.open(str(folder), map_size=MAP_BYTES, max_dbs=len(TABLES), max_readers=64)
        self._db = {name: self._env.open_db(name.encode()) for name in TABLES}
        with self._env.begin(write=True) as txn:
            known = self._meta(txn, "identity")
            if known is None:
                self._put_meta(txn, "identity", [SCHEMA, identity])
                self._put_meta(txn, "counters", Counters().to_dict())
                start = Position(0, 0, 0, 0, config.threshold_percent)
                self._put_meta(txn, "position", asdict(start))
                self._put_meta(txn, "worlds", [])
            elif list(known) != [SCHEMA, identity]:
                raise StateError(
                    f"{folder}: expected a replay memory of schema and run {[SCHEMA, identity]}, "
                    f"found {list(known)}: choose another run folder"
                )

    def close(self) -> None:
        """Close the files; all other threads must be done with them."""
        self._env.close()

    # ------------------------------------------------------------ submissions

    def counters(self) -> Counters:
        """The counters as of the newest commit."""
        with self._env.begin() as txn:
            return Counters.from_dict(self._meta(txn, "counters"))

    def position(self) -> Position:
        """How far the turns have come."""
        with self._env.begin() as txn:
            return Position(**self._meta(txn, "position"))

    def commit(self, episode: Episode) -> Accepted:
        """Write one submission, or recognise it as already written; on disk when this returns.

        Raises ValueError with the reason when it cannot be accepted.
        """
        identity = f"{episode.robot}/{episode.life}/{episode.number}".encode()
        with self._env.begin(write=True) as txn:
            counters = Counters.from_dict(self._meta(txn, "counters"))
            known = txn.get(identity, db=self._db["identity"])
            if known is not None:
                record = _unpack(txn.get(known, db=self._db["commits"]))
                return Accepted(Commit(**record["commit"]), counters, duplicate=True)
            reason = numbering.refusal(counters, self._config, episode)
            if reason:
                raise ValueError(reason)
            commit, counters = numbering.accept(counters, self._config, episode)
            self._write_samples(txn, episode, commit)
            record = {"commit": asdict(commit), "totals": _totals(counters), **_summary(episode)}
            txn.put(_key(commit.commit), _pack(record), db=self._db["commits"])
            txn.put(identity, _key(commit.commit), db=self._db["identity"])
            self._put_meta(txn, "counters", counters.to_dict())
        return Accepted(commit, counters, duplicate=False)

    def _write_samples(self, txn: Txn, episode: Episode, commit: Commit) -> None:
        memory = ReplayMemory(1)
        memory.worlds = list(self._meta(txn, "worlds"))
        rows, images = sample_rows(memory, episode, commit.first_id, commit.commit, commit.episode)
        self._put_meta(txn, "worlds", memory.worlds)
        keys = [_key(commit.first_id + i) for i in range(commit.stored)]
        for table, values in (
            ("images", [image.tobytes() for image in images[: commit.stored]]),
            ("samples", [row.tobytes() for row in rows[: commit.stored]]),
        ):
            with txn.cursor(self._db[table]) as cursor:
                cursor.putmulti(list(zip(keys, values, strict=True)), append=True)

    # ------------------------------------------------------------ turns

    def pending(self, after: int) -> tuple[Commit, dict[str, Any]] | None:
        """The commit after number `after`, with the summary of its episode, if there is one."""
        with self._env.begin() as txn:
            data = txn.get(_key(after + 1), db=self._db["commits"])
        if data is None:
            return None
        record = _unpack(data)
        return Commit(**record["commit"]), record

    def records(self, after: int) -> list[dict[str, Any]]:
        """Records of all counted episodes beyond global number `after`, in order."""
        with self._env.begin() as txn:
            records = [_unpack(data) for _, data in txn.cursor(self._db["commits"])]
        return [r for r in records if r["commit"]["episode"] > after]

    def rows_of(self, commit: Commit) -> tuple[npt.NDArray[np.void], npt.NDArray[np.uint8]]:
        """The rows and images a commit brought."""
        ids = range(commit.first_id, commit.first_id + commit.stored)
        with self._env.begin() as txn:
            return self._rows(txn, list(ids))

    def apply_turn(
        self,
        commit: Commit,
        summary: dict[str, Any],
        memory: ReplayMemory,
        done: Maintenance,
    ) -> Position:
        """Write everything one turn changed, in one transaction, and number the changes."""
        with self._env.begin(write=True) as txn:
            position = Position(**self._meta(txn, "position"))
            number = position.change
            if commit.stored:
                number += 1
                self._put_change(txn, number, "append", [commit.first_id, commit.stored])
            removed = done.discarded.ids
            if len(removed):
                number += 1
                self._put_change(txn, number, "discard", removed.astype("<u8").tobytes())
                with txn.cursor(self._db["dead"]) as cursor:
                    cursor.putmulti([(_key(int(i)), _key(number)) for i in removed])
            if done.equalised:
                number += 1
                column = _column(memory, REWARDS)
                self._put_change(txn, number, "rewards", column)
                txn.put(b"rewards", column, db=self._db["columns"])
            if done.discarded.recomputed:
                txn.put(b"marks", _column(memory, MARKS), db=self._db["columns"])
            turn, turn_change = position.turn, position.turn_change
            if commit.episode:
                turn, turn_change = commit.episode, number
                entry = {
                    "change": number,
                    "bump": bool(summary["bump"]),
                    "actions": int(summary["actions"]),
                    "samples": commit.stored,
                }
                txn.put(_key(turn), _pack(entry), db=self._db["turns"])
            position = Position(
                number, commit.commit, turn, turn_change, done.discarded.threshold_percent
            )
            self._put_meta(txn, "position", asdict(position))
            self._forget_changes(txn, number)
        return position

    def turns(self, since: int, limit: int) -> tuple[Turn, ...]:
        """Turns after episode `since`, in order, without gaps, at most `limit`."""
        found = []
        with self._env.begin() as txn, txn.cursor(self._db["turns"]) as cursor:
            if cursor.set_range(_key(since + 1)):
                for key, data in cursor:
                    found.append(Turn(episode=_number(key), **_unpack(data)))
                    if len(found) == limit:
                        break
        return tuple(found)

    def load(self) -> ReplayMemory:
        """The memory as of the newest applied turn."""
        memory = ReplayMemory(self._config.capacity)
        with self._env.begin() as txn:
            memory.worlds = list(self._meta(txn, "worlds"))
            ids = self._alive(txn)
            for start in range(0, len(ids), PART_ROWS * 16):
                rows, images = self._rows(txn, ids[start : start + PART_ROWS * 16])
                memory.append(rows, images)
            self._overlay_rewards(txn, memory.rows)
            marks = self._stored_column(txn, "marks", MARKS)
        known, where = _match(memory.ids, marks["id"])
        for name in ("descriptor", "described_by", "candidate", "forced", "marked_by"):
            memory.rows[name][known] = marks[name][where]
        return memory

    # ------------------------------------------------------------ the feed

    def changes(self, since: int, upto: int) -> Iterator[Change | FeedEnd]:
        """All changes in (since, upto] in parts of about 1 MB, then a `FeedEnd`."""
        with self._env.begin() as txn:
            newest = Position(**self._meta(txn, "position")).change
            upto = min(upto, newest)
            with txn.cursor(self._db["changes"]) as cursor:
                oldest = _number(cursor.key()) if cursor.first() else newest + 1
            if (since < upto and since + 1 < oldest) or since > newest:
                yield FeedEnd(change=since, rows=0, messages=0, gone=True)
                return
            rows = messages = 0
            for number in range(since + 1, upto + 1):
                kind, what = _unpack(txn.get(_key(number), db=self._db["changes"]))
                for part in self._parts(txn, number, kind, what):
                    rows, messages = rows + len(part.ids) // 8, messages + 1
                    yield part
            yield FeedEnd(change=max(upto, since), rows=rows, messages=messages)

    def snapshot(self) -> Iterator[Change | FeedEnd]:
        """The whole memory at the newest turn, from one read transaction."""
        with self._env.begin() as txn:
            number = Position(**self._meta(txn, "position")).change
            ids = self._alive(txn)
            messages = 0
            for start in range(0, len(ids), PART_ROWS):
                rows, images = self._rows(txn, ids[start : start + PART_ROWS])
                self._overlay_rewards(txn, rows)
                messages += 1
                last = start + PART_ROWS >= len(ids)
                yield _appended(number, last, rows, images)
            yield FeedEnd(change=number, rows=len(ids), messages=messages)

    def mini_batch(self, ranks: npt.NDArray[np.int64]) -> Change:
        """The samples at these ranks of insertion number, with current rewards."""
        with self._env.begin() as txn:
            number = Position(**self._meta(txn, "position")).change
            alive = self._alive(txn)
            rows, images = self._rows(txn, sorted(alive[rank] for rank in ranks))
            self._overlay_rewards(txn, rows)
            return _appended(number, True, rows, images)

    def size(self) -> int:
        """Samples in memory at the newest turn."""
        with self._env.begin() as txn:
            return len(self._alive(txn))

    # ------------------------------------------------------------ inside

    def _meta(self, txn: Txn, name: str) -> Any:
        data = txn.get(name.encode(), db=self._db["meta"])
        return None if data is None else _unpack(data)

    def _put_meta(self, txn: Txn, name: str, value: Any) -> None:
        txn.put(name.encode(), _pack(value), db=self._db["meta"])

    def _put_change(self, txn: Txn, number: int, kind: str, what: Any) -> None:
        txn.put(_key(number), _pack([kind, what]), db=self._db["changes"])

    def _alive(self, txn: Txn) -> list[int]:
        """Insertion numbers of all samples whose append is applied and whose discard is not."""
        processed = Position(**self._meta(txn, "position")).processed
        data = txn.get(_key(processed), db=self._db["commits"])
        if data is None:
            return []
        commit = Commit(**_unpack(data)["commit"])
        end = commit.first_id + commit.stored
        with txn.cursor(self._db["dead"]) as cursor:
            dead = {_number(key) for key in cursor.iternext(values=False)}
        with txn.cursor(self._db["samples"]) as cursor:
            ids = [_number(key) for key in cursor.iternext(values=False)]
        return [i for i in ids if i < end and i not in dead]

    def _rows(self, txn: Txn, ids: list[int]) -> tuple[npt.NDArray[np.void], npt.NDArray[np.uint8]]:
        keys = [_key(i) for i in ids]
        parts: dict[str, bytes] = {}
        for table in ("samples", "images"):
            with txn.cursor(self._db[table]) as cursor:
                found = cursor.getmulti(keys)
            if len(found) != len(keys):
                raise StateError(f"replay {table}: {len(keys) - len(found)} of {len(keys)} missing")
            parts[table] = b"".join(value for _, value in found)
        rows = np.frombuffer(parts["samples"], SAMPLE).copy()
        images = np.frombuffer(parts["images"], np.uint8).reshape(len(ids), *IMAGE_SHAPE)
        return rows, images

    def _stored_column(self, txn: Txn, name: str, dtype: np.dtype[np.void]) -> npt.NDArray[np.void]:
        return np.frombuffer(txn.get(name.encode(), db=self._db["columns"]) or b"", dtype)

    def _overlay_rewards(self, txn: Txn, rows: npt.NDArray[np.void]) -> None:
        """Replace rewards as inserted by those of the newest equalisation."""
        column = self._stored_column(txn, "rewards", REWARDS)
        known, where = _match(rows["id"], column["id"])
        rows["reward"][known] = column["reward"][where]

    def _parts(self, txn: Txn, number: int, kind: str, what: Any) -> Iterator[Change]:
        if kind == "append":
            first, count = what
            for start in range(0, count, PART_ROWS):
                stop = min(start + PART_ROWS, count)
                rows, images = self._rows(txn, list(range(first + start, first + stop)))
                yield _appended(number, stop == count, rows, images)
        elif kind == "discard":
            yield Change(number=number, last=True, kind="discard", ids=what)
        else:
            column = np.frombuffer(what, REWARDS)
            ids, rewards = column["id"].tobytes(), column["reward"].tobytes()
            yield Change(number=number, last=True, kind="rewards", ids=ids, rewards=rewards)

    def _forget_changes(self, txn: Txn, newest: int) -> None:
        """Delete old changes, and with a forgotten discard the samples it removed."""
        most_dead = max(self._config.capacity // 2, 1000)
        with txn.cursor(self._db["changes"]) as cursor:
            while cursor.first() and (
                _number(cursor.key()) <= newest - CHANGES_KEPT
                or txn.stat(self._db["dead"])["entries"] > most_dead
            ):
                kind, what = _unpack(cursor.value())
                if kind == "discard":
                    for i in np.frombuffer(what, "<u8"):
                        for table in ("images", "samples", "dead"):
                            txn.delete(_key(int(i)), db=self._db[table])
                cursor.delete()


def _match(
    ids: npt.NDArray[np.uint64], known: npt.NDArray[np.uint64]
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.int64]]:
    """Which of `ids` are in the ascending `known`, and where."""
    if not len(known):
        return np.zeros(len(ids), np.bool_), np.zeros(0, np.int64)
    where = np.minimum(np.searchsorted(known, ids), len(known) - 1)
    found = known[where] == ids
    return found, where[found]


def _column(memory: ReplayMemory, dtype: np.dtype[np.void]) -> bytes:
    """Some fields of all rows as bytes."""
    column = np.zeros(len(memory), dtype)
    for name in dtype.names or ():
        column[name] = memory.rows[name]
    return column.tobytes()


def _appended(
    number: int, last: bool, rows: npt.NDArray[np.void], images: npt.NDArray[np.uint8]
) -> Change:
    assert images.nbytes == len(rows) * IMAGE_BYTES
    return Change(
        number=number,
        last=last,
        kind="append",
        ids=rows["id"].astype("<u8").tobytes(),
        images=images.tobytes(),
        actions=rows["action"].tobytes(),
        rewards=rows["reward"].astype("<f4").tobytes(),
    )


def _summary(episode: Episode) -> dict[str, Any]:
    """What is kept of a submission beside its samples."""
    names = (
        "robot life number fill ended bump weights_version fitness actions dropped_samples "
        "dropped_episodes robot_life last_sequence laps_left laps_right digest"
    )
    return {name: getattr(episode, name) for name in names.split()}


def _totals(counters: Counters) -> dict[str, int]:
    """Running totals for the metrics row of a commit."""
    names = "bumps actions laps_left laps_right run_actions longest_run_actions"
    return {name: getattr(counters, name) for name in names.split()}
