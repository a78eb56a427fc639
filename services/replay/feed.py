"""The feed: numbered changes as they are written, and what learners pull of the memory."""

from collections.abc import Iterator
from typing import Any, Literal

import numpy as np

from services.replay.tables import REWARDS, Position, Tables, Txn, key_of, number_of, pack, unpack
from shared.columns import CHANGES
from shared.messages import Change, FeedEnd

PART_ROWS = 256
"""Rows of one reply: about 1 MB."""
CHANGES_KEPT = 512
"""Changes a learner may lag behind before it needs a snapshot."""
Kind = Literal["append", "discard", "rewards"]


class Feed:
    """The changes on disk. Reading them disturbs no thread that writes."""

    def __init__(self, tables: Tables) -> None:
        self._tables = tables
        self._listed: tuple[int, list[int]] | None = None
        """Insertion numbers after a change, kept for as long as nothing changes."""

    def note(self, txn: Txn, number: int, kind: Kind, what: Any, lineage: str) -> None:
        """Write a change. `lineage` is that of the memory before it.

        what: of an append first insertion number and count, of a discard the insertion numbers as
        bytes, of rewards the column `REWARDS` as bytes.
        """
        txn.put(key_of(number), pack([kind, what, lineage]), db=self._tables.db["changes"])

    def forget(self, txn: Txn, position: Position) -> None:
        """Delete old changes, and with a forgotten discard the samples it removed."""
        db, most_dead = self._tables.db, max(position.capacity // 2, 1000)
        with txn.cursor(db["changes"]) as cursor:
            while cursor.first() and (
                number_of(cursor.key()) <= position.change - CHANGES_KEPT
                or txn.stat(db["dead"])["entries"] > most_dead
            ):
                kind, what, _ = unpack(cursor.value())
                if kind == "discard":
                    for i in np.frombuffer(what, "<u8"):
                        for table in ("images", "samples", "dead"):
                            txn.delete(key_of(int(i)), db=db[table])
                cursor.delete()

    def changes(self, since: int, upto: int, lineage: str) -> Iterator[Change | FeedEnd]:
        """Yield all changes in (since, upto] in parts of about 1 MB, then a `FeedEnd`.

        lineage: that of the mirror at `since`; no change fits the mirror of another memory.
        """
        with self._tables.env.begin() as txn:
            newest = self._tables.position(txn)
            upto = max(min(upto, newest.change), since)
            if self._lineage(txn, newest, since) != lineage:
                yield FeedEnd(change=since, rows=0, messages=0, lineage=newest.lineage, gone=True)
                return
            rows = messages = 0
            for number in range(since + 1, upto + 1):
                for part in self._parts(txn, number):
                    rows, messages = rows + part.count, messages + 1
                    yield part
            reached = self._lineage(txn, newest, upto)
            yield FeedEnd(change=upto, rows=rows, messages=messages, lineage=reached)

    def snapshot(self) -> Iterator[Change | FeedEnd]:
        """Yield the whole memory at the newest turn, from one read transaction."""
        with self._tables.env.begin() as txn:
            newest = self._tables.position(txn)
            ids, messages = self._tables.alive(txn), 0
            for part in self._appended(txn, newest.change, ids, current=True):
                messages += 1
                yield part
            yield FeedEnd(
                change=newest.change, rows=len(ids), messages=messages, lineage=newest.lineage
            )

    def mini_batch(self, size: int, draw: np.random.Generator) -> Change:
        """Return at most `size` samples without replacement, drawn by rank, with their rewards."""
        with self._tables.env.begin() as txn:
            number = self._tables.position(txn).change
            if self._listed is None or self._listed[0] != number:
                self._listed = number, self._tables.alive(txn)
            alive = self._listed[1]
            ranks = draw.choice(len(alive), size=min(size, len(alive)), replace=False)
            ids = sorted(alive[rank] for rank in ranks)
            return self._part(txn, number, ids, last=True, current=True)

    def _lineage(self, txn: Txn, newest: Position, number: int) -> str:
        """The lineage as of a change; empty if it is not kept, or if there is no such change."""
        if number == newest.change:
            return newest.lineage
        data = txn.get(key_of(number + 1), db=self._tables.db["changes"])
        return "" if data is None else str(unpack(data)[2])

    def _parts(self, txn: Txn, number: int) -> Iterator[Change]:
        """Yield the parts of a change that `note` wrote."""
        kind, what, _ = unpack(txn.get(key_of(number), db=self._tables.db["changes"]))
        if kind == "append":
            first, count = what
            yield from self._appended(txn, number, list(range(first, first + count)), current=False)
        elif kind == "discard":
            yield _change(number, True, "discard", ids=np.frombuffer(what, "<u8"))
        else:
            column = np.frombuffer(what, REWARDS)
            yield _change(number, True, "rewards", ids=column["id"], rewards=column["reward"])

    def _appended(
        self, txn: Txn, number: int, ids: list[int], *, current: bool
    ) -> Iterator[Change]:
        for start in range(0, len(ids), PART_ROWS):
            last = start + PART_ROWS >= len(ids)
            part = ids[start : start + PART_ROWS]
            yield self._part(txn, number, part, last=last, current=current)

    def _part(self, txn: Txn, number: int, ids: list[int], *, last: bool, current: bool) -> Change:
        """Return samples as appended, with current rewards or those they were inserted with."""
        rows, images = self._tables.rows(txn, ids)
        if current:
            self._tables.overlay_rewards(txn, rows)
        return _change(
            number,
            last,
            "append",
            ids=rows["id"],
            images=images,
            actions=rows["action"],
            rewards=rows["reward"],
        )


def _change(number: int, last: bool, kind: Kind, **values: Any) -> Change:
    """Return a part of change `number` with the arrays that its kind has (`columns.CHANGES`)."""
    return Change(number=number, last=last, kind=kind, **CHANGES[kind].encode(values))
