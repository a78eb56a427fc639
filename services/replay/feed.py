"""What the learner pulls: numbered changes, snapshots and mini-batches from read transactions."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from services.replay.tables import REWARDS, Position, Tables, Txn, key_of, number_of, unpack
from shared.messages import Change, FeedEnd

PART_ROWS = 256
"""Rows of one reply: about 1 MB."""


class Feed(Tables):
    """Reading the memory for others, beside the threads that write it."""

    _listed: tuple[int, list[int]] | None = None

    def changes(self, since: int, upto: int) -> Iterator[Change | FeedEnd]:
        """All changes in (since, upto] in parts of about 1 MB, then a `FeedEnd`."""
        with self._env.begin() as txn:
            newest = Position(**self._meta(txn, "position")).change
            upto = min(upto, newest)
            with txn.cursor(self._db["changes"]) as cursor:
                oldest = number_of(cursor.key()) if cursor.first() else newest + 1
            if (since < upto and since + 1 < oldest) or since > newest:
                yield FeedEnd(change=since, rows=0, messages=0, gone=True)
                return
            rows = messages = 0
            for number in range(since + 1, upto + 1):
                kind, what = unpack(txn.get(key_of(number), db=self._db["changes"]))
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

    def mini_batch(self, size: int, draw: np.random.Generator) -> Change:
        """At most `size` samples without replacement, drawn by rank, with current rewards."""
        with self._env.begin() as txn:
            number = Position(**self._meta(txn, "position")).change
            alive = self._alive_at(txn, number)
            ranks = draw.choice(len(alive), size=min(size, len(alive)), replace=False)
            rows, images = self._rows(txn, sorted(alive[rank] for rank in ranks))
            self._overlay_rewards(txn, rows)
            return _appended(number, True, rows, images)

    def _alive_at(self, txn: Txn, number: int) -> list[int]:
        """Insertion numbers after this change, kept for as long as nothing changes."""
        if self._listed is None or self._listed[0] != number:
            self._listed = number, self._alive(txn)
        return self._listed[1]

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


def _appended(
    number: int, last: bool, rows: npt.NDArray[np.void], images: npt.NDArray[np.uint8]
) -> Change:
    return Change(
        number=number,
        last=last,
        kind="append",
        ids=rows["id"].astype("<u8").tobytes(),
        images=images.tobytes(),
        actions=rows["action"].tobytes(),
        rewards=rows["reward"].astype("<f4").tobytes(),
    )
