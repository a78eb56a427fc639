"""Writing the replay memory: submissions, turns, and loading what was written."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from services.replay import numbering
from services.replay.feed import PART_ROWS, Feed
from services.replay.numbering import Commit, Counters
from services.replay.tables import (
    MARKS,
    REWARDS,
    Position,
    Txn,
    key_of,
    match,
    number_of,
    pack,
    unpack,
)
from shared.messages import Episode, Turn
from shared.rl.memory import ReplayMemory
from shared.rl.retention.strategy import columns
from shared.rl.turn import Maintenance, sample_rows

CHANGES_KEPT = 512
"""Changes a learner may lag behind before it needs a snapshot."""


@dataclass(frozen=True)
class Accepted:
    """Result of a submission."""

    commit: Commit
    counters: Counters
    duplicate: bool


class Storage(Feed):
    """All access to the files. Writing methods may be called from two threads: LMDB serialises."""

    def commit(self, episode: Episode) -> Accepted:
        """Write one submission, or recognise it as already written; on disk when this returns.

        Raises ValueError with the reason when it cannot be accepted.
        """
        identity = f"{episode.robot}/{episode.life}/{episode.number}".encode()
        with self._env.begin(write=True) as txn:
            counters = Counters.from_dict(self._meta(txn, "counters"))
            known = txn.get(identity, db=self._db["identity"])
            if known is not None:
                record = unpack(txn.get(known, db=self._db["commits"]))
                return Accepted(Commit(**record["commit"]), counters, duplicate=True)
            reason = numbering.refusal(counters, self._config, episode)
            if reason:
                raise ValueError(reason)
            commit, counters = numbering.accept(counters, self._config, episode)
            self._write_samples(txn, episode, commit)
            record = {"commit": asdict(commit), "totals": _totals(counters), **_summary(episode)}
            txn.put(key_of(commit.commit), pack(record), db=self._db["commits"])
            txn.put(identity, key_of(commit.commit), db=self._db["identity"])
            self._put_meta(txn, "counters", counters.to_dict())
        return Accepted(commit, counters, duplicate=False)

    def _write_samples(self, txn: Txn, episode: Episode, commit: Commit) -> None:
        memory = ReplayMemory(1)
        memory.worlds = list(self._meta(txn, "worlds"))
        rows, images = sample_rows(memory, episode, commit.first_id, commit.commit, commit.episode)
        self._put_meta(txn, "worlds", memory.worlds)
        keys = [key_of(commit.first_id + i) for i in range(commit.stored)]
        for table, values in (
            ("images", [image.tobytes() for image in images[: commit.stored]]),
            ("samples", [row.tobytes() for row in rows[: commit.stored]]),
        ):
            with txn.cursor(self._db[table]) as cursor:
                cursor.putmulti(list(zip(keys, values, strict=True)), append=True)

    def pending(self, after: int) -> tuple[Commit, dict[str, Any]] | None:
        """The commit after number `after`, with the summary of its episode, if there is one."""
        with self._env.begin() as txn:
            data = txn.get(key_of(after + 1), db=self._db["commits"])
        if data is None:
            return None
        record = unpack(data)
        return Commit(**record["commit"]), record

    def records(self, after: int) -> list[dict[str, Any]]:
        """Records of all counted episodes beyond global number `after`, in order."""
        with self._env.begin() as txn:
            records = [unpack(data) for _, data in txn.cursor(self._db["commits"])]
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
                    cursor.putmulti([(key_of(int(i)), key_of(number)) for i in removed])
            if done.equalised:
                number += 1
                column = _column(memory, REWARDS)
                self._put_change(txn, number, "rewards", column)
                txn.put(b"rewards", column, db=self._db["columns"])
            if done.discarded.marked:
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
                txn.put(key_of(turn), pack(entry), db=self._db["turns"])
            position = Position(
                number, commit.commit, turn, turn_change, memory.capacity, memory.kept
            )
            self._put_meta(txn, "position", asdict(position))
            self._forget_changes(txn, position)
        return position

    def turns(self, since: int, limit: int) -> tuple[Turn, ...]:
        """Turns after episode `since`, in order, without gaps, at most `limit`."""
        found = []
        with self._env.begin() as txn, txn.cursor(self._db["turns"]) as cursor:
            if cursor.set_range(key_of(since + 1)):
                for key, data in cursor:
                    found.append(Turn(episode=number_of(key), **unpack(data)))
                    if len(found) == limit:
                        break
        return tuple(found)

    def load(self) -> ReplayMemory:
        """The memory as of the newest applied turn."""
        with self._env.begin() as txn:
            position = Position(**self._meta(txn, "position"))
            memory = ReplayMemory(position.capacity)
            memory.kept = position.kept
            memory.worlds = list(self._meta(txn, "worlds"))
            ids = self._alive(txn)
            for start in range(0, len(ids), PART_ROWS):
                rows, images = self._rows(txn, ids[start : start + PART_ROWS])
                memory.append(rows, images)
            self._overlay_rewards(txn, memory.rows)
            marks = self._stored_column(txn, "marks", MARKS)
        known, where = match(memory.ids, marks["id"])
        for name, *_ in columns():
            memory.rows[name][known] = marks[name][where]
        return memory

    def _put_change(self, txn: Txn, number: int, kind: str, what: Any) -> None:
        txn.put(key_of(number), pack([kind, what]), db=self._db["changes"])

    def _forget_changes(self, txn: Txn, position: Position) -> None:
        """Delete old changes, and with a forgotten discard the samples it removed."""
        most_dead = max(position.capacity // 2, 1000)
        with txn.cursor(self._db["changes"]) as cursor:
            while cursor.first() and (
                number_of(cursor.key()) <= position.change - CHANGES_KEPT
                or txn.stat(self._db["dead"])["entries"] > most_dead
            ):
                kind, what = unpack(cursor.value())
                if kind == "discard":
                    for i in np.frombuffer(what, "<u8"):
                        for table in ("images", "samples", "dead"):
                            txn.delete(key_of(int(i)), db=self._db[table])
                cursor.delete()


def _column(memory: ReplayMemory, dtype: np.dtype[np.void]) -> bytes:
    """Some fields of all rows as bytes."""
    column = np.zeros(len(memory), dtype)
    for name in dtype.names or ():
        column[name] = memory.rows[name]
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
