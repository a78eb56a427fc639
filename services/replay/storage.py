"""Writing the replay memory: submissions, turns, and loading what was written."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from services.replay import numbering
from services.replay.feed import Feed
from services.replay.numbering import Counters, Span
from services.replay.tables import (
    MARKS,
    REWARDS,
    Position,
    Tables,
    Txn,
    key_of,
    number_of,
    pack,
    unpack,
)
from shared.config import MemoryConfig
from shared.messages import NO_LINEAGE, Episode, Turn
from shared.rl.memory import ReplayMemory
from shared.rl.turn import Commit, Maintenance, sample_rows

MAX_WORLDS = 1024
"""Names of worlds that one memory keeps."""


class Refused(ValueError):
    """Why a submission can never be stored, after its kind and a colon."""


@dataclass(frozen=True)
class Accepted:
    """Result of a submission."""

    commit: Commit
    counters: Counters
    duplicate: bool


@dataclass(frozen=True)
class Submission:
    """A submission that is on disk, with all that its turn needs."""

    commit: Commit
    record: dict[str, Any]
    """The summary of its episode, and totals."""
    rows: npt.NDArray[np.void]
    images: npt.NDArray[np.uint8]
    worlds: list[str]
    """Names that the rows' column points into."""


class Storage:
    """What is written and loaded. Two threads may write: LMDB lets one after the other do so."""

    def __init__(self, folder: Path, config: MemoryConfig, identity: str) -> None:
        """Open or create. Raises StateError when the files belong to another run or schema."""
        self._config = config
        self._tables = Tables(folder)
        self._tables.belong_to(config, identity)
        self.feed = Feed(self._tables)

    def close(self) -> None:
        """Close the files; all other threads must be done with them."""
        self._tables.env.close()

    def counters(self) -> Counters:
        """Return the counters as of the newest commit."""
        with self._tables.env.begin() as txn:
            return Counters.from_dict(self._tables.meta(txn, "counters"))

    def position(self) -> Position:
        """Return how far the turns have come."""
        with self._tables.env.begin() as txn:
            return self._tables.position(txn)

    def newest_weights_version(self) -> int:
        """Return the weights version of the newest commit; 0 without one."""
        with self._tables.env.begin() as txn, txn.cursor(self._tables.db["commits"]) as cursor:
            return int(unpack(cursor.value())["weights_version"]) if cursor.last() else 0

    def commit(self, episode: Episode) -> Accepted:
        """Write one submission to disk, or know it as written. Raises Refused if it cannot be."""
        identity = f"{episode.robot}/{episode.life}/{episode.number}"
        summary, db = _summary(episode), self._tables.db
        with self._tables.writing() as txn:
            counters = Counters.from_dict(self._tables.meta(txn, "counters"))
            known = txn.get(identity.encode(), db=db["identity"])
            if known is not None:
                record = unpack(txn.get(known, db=db["commits"]))
                if any(record[name] != value for name, value in summary.items()):
                    raise Refused(f"identity: {identity} is stored with other content")
                return Accepted(Commit(**record["commit"]), counters, duplicate=True)
            driver = f"{episode.robot}/{episode.robot_life}".encode()
            spans = _spans(txn.get(driver, db=db["lives"]))
            if reason := numbering.refusal(counters, self._config, episode, spans):
                raise Refused(reason)
            lineage = numbering.lineage_after(
                self._lineage(txn, counters.commit), identity, summary["digest"]
            )
            commit, counters = numbering.accept(counters, self._config, episode)
            self._write_samples(txn, episode, commit)
            record = {"commit": asdict(commit), "totals": _totals(counters), "lineage": lineage}
            txn.put(key_of(commit.commit), pack(record | summary), db=db["commits"])
            txn.put(identity.encode(), key_of(commit.commit), db=db["identity"])
            spans = numbering.settled(spans, episode.last_sequence)
            txn.put(driver, b"".join(key_of(n) for span in spans for n in span), db=db["lives"])
            self._tables.put_meta(txn, "counters", asdict(counters))
        return Accepted(commit, counters, duplicate=False)

    def _lineage(self, txn: Txn, commit: int) -> str:
        """The lineage as of a commit."""
        if not commit:
            return NO_LINEAGE
        return str(unpack(txn.get(key_of(commit), db=self._tables.db["commits"]))["lineage"])

    def _write_samples(self, txn: Txn, episode: Episode, commit: Commit) -> None:
        """Write the stored samples. Raises Refused for too many worlds."""
        worlds = list(self._tables.meta(txn, "worlds"))
        if len({*worlds, *episode.worlds}) > MAX_WORLDS:
            raise Refused(f"worlds: expected at most {MAX_WORLDS} names in one memory")
        rows, images = sample_rows(episode, worlds, commit)
        self._tables.put_meta(txn, "worlds", worlds)
        keys = [key_of(commit.first_id + i) for i in range(commit.stored)]
        for table, values in (("images", images), ("samples", rows)):
            with txn.cursor(self._tables.db[table]) as cursor:
                pairs = zip(keys, (value.tobytes() for value in values), strict=True)
                cursor.putmulti(list(pairs), append=True)

    def pending(self, after: int) -> Submission | None:
        """Return the submission after commit `after`, if there is one."""
        tables = self._tables
        with tables.env.begin() as txn:
            data = txn.get(key_of(after + 1), db=tables.db["commits"])
            if data is None:
                return None
            record = unpack(data)
            commit = Commit(**record["commit"])
            ids = range(commit.first_id, commit.first_id + commit.stored)
            rows, images = tables.rows(txn, list(ids))
            return Submission(commit, record, rows, images, list(tables.meta(txn, "worlds")))

    def records(self) -> list[dict[str, Any]]:
        """Return the records of all submissions in order, also of those whose samples are gone."""
        with self._tables.env.begin() as txn:
            return [unpack(data) for _, data in txn.cursor(self._tables.db["commits"])]

    def apply_turn(
        self, submission: Submission, memory: ReplayMemory, done: Maintenance
    ) -> Position:
        """Write everything one turn changed, in one transaction, and number the changes."""
        commit, summary = submission.commit, submission.record
        with self._tables.writing() as txn:
            position = self._tables.position(txn)
            number = self._write_changes(txn, position, submission, memory, done)
            if done.discarded.marked:
                txn.put(b"marks", _column(memory.rows, MARKS), db=self._tables.db["columns"])
            lineage = summary["lineage"] if number > position.change else position.lineage
            turn, change, turn_lineage = position.turn, position.turn_change, position.turn_lineage
            if commit.episode:
                turn, change, turn_lineage = commit.episode, number, lineage
                entry = {
                    "change": number,
                    **{name: summary[name] for name in ("bump", "actions")},
                    "total_actions": summary["totals"]["actions"],
                    "samples": commit.stored,
                    "lineage": lineage,
                }
                txn.put(key_of(turn), pack(entry), db=self._tables.db["turns"])
            position = Position(
                *(number, commit.commit, turn, change, memory.capacity, memory.kept),
                lineage=lineage,
                turn_lineage=turn_lineage,
            )
            self._tables.put_meta(txn, "position", asdict(position))
            self.feed.forget(txn, position)
        return position

    def _write_changes(
        self,
        txn: Txn,
        position: Position,
        submission: Submission,
        memory: ReplayMemory,
        done: Maintenance,
    ) -> int:
        """Note the changes of one turn; return the number of the last."""
        commit, removed, number = submission.commit, done.discarded.ids, position.change
        lineages = iter((position.lineage, *[submission.record["lineage"]] * 2))
        if commit.stored:
            number += 1
            what = [commit.first_id, commit.stored]
            self.feed.note(txn, number, "append", what, next(lineages))
        if len(removed):
            number += 1
            ids = removed.astype("<u8").tobytes()
            self.feed.note(txn, number, "discard", ids, next(lineages))
            if done.discarded.removed is not None:
                gone = _column(done.discarded.removed, MARKS)
                txn.put(b"removed", gone, db=self._tables.db["columns"])
            with txn.cursor(self._tables.db["dead"]) as cursor:
                cursor.putmulti([(key_of(int(i)), key_of(number)) for i in removed])
        if done.equalised:
            number += 1
            column = _column(memory.rows, REWARDS)
            self.feed.note(txn, number, "rewards", column, next(lineages))
            txn.put(b"rewards", column, db=self._tables.db["columns"])
        return number

    def turns(self, since: int, limit: int) -> tuple[Turn, ...]:
        """Turns after episode `since`, in order, without gaps, at most `limit`."""
        found = []
        with self._tables.env.begin() as txn, txn.cursor(self._tables.db["turns"]) as cursor:
            if cursor.set_range(key_of(since + 1)):
                for key, data in cursor:
                    found.append(Turn(episode=number_of(key), **unpack(data)))
                    if len(found) == limit:
                        break
        return tuple(found)

    def load(self) -> ReplayMemory:
        """The memory as of the newest applied turn."""
        memory = ReplayMemory(1)
        self._tables.update(memory)
        return memory


def _spans(data: bytes | None) -> list[Span]:
    """What is settled of a driver's life. Once only the last number of one span was kept."""
    data = bytes(8 * (len(data) == 8)) + data if data else b""
    numbers = [number_of(data[at : at + 8]) for at in range(0, len(data), 8)]
    return list(zip(numbers[::2], numbers[1::2], strict=True))


def _column(rows: npt.NDArray[np.void], dtype: np.dtype[np.void]) -> bytes:
    """Some fields of all rows as bytes."""
    column = np.zeros(len(rows), dtype)
    for name in dtype.names or ():
        column[name] = rows[name]
    return column.tobytes()


def _summary(episode: Episode) -> dict[str, Any]:
    """What is kept of a submission beside its samples."""
    names = (
        "robot life number fill ended bump weights_version fitness actions dropped_samples "
        "dropped_episodes robot_life last_sequence laps_left laps_right digest"
    )
    return {name: getattr(episode, name) for name in names.split()}


def _totals(counters: Counters) -> dict[str, int]:
    """Running totals for the metrics row of a commit."""
    names = "bumps actions laps_left laps_right longest_run_actions"
    return {name: getattr(counters, name) for name in names.split()}
