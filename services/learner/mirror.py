"""The learner's copy of the memory, pulled change by change and exact at a known number."""

from collections.abc import Callable, Iterator

import numpy as np

from shared import columns
from shared.bus import Bus
from shared.errors import PeerSilent
from shared.keys import CHANGES, SNAPSHOT, Stream
from shared.messages import NO_LINEAGE, Change, ChangesRequest, FeedEnd, Message, SnapshotRequest
from shared.rl.memory import MIRROR, SampleStore

PATIENCE_S = 60.0
"""Longest that a transfer stands still; one that goes on takes as long as it takes."""


class Mirror:
    """Samples as replay had them after change `number`; None before the first snapshot."""

    def __init__(self) -> None:
        self.samples = SampleStore()
        self.number: int | None = None
        self.lineage = NO_LINEAGE
        """Lineage of the mirrored memory as of `number`."""
        self.resyncs = 0

    def reach(
        self, bus: Bus, number: int, lineage: str, progress: Callable[[], None] = lambda: None
    ) -> None:
        """Bring the mirror to change `number` (beyond it only after a gap: then by snapshot).

        lineage: of the memory as of that change. progress: called for each part; what it raises
        ends the transfer. Raises BusError; the mirror then stands at a complete change, or starts
        anew.
        """
        if self.number is not None and self.number >= number:
            return
        if self.number is not None:
            request = ChangesRequest(since=self.number, upto=number, lineage=self.lineage)
            received = list(_received(bus, CHANGES, request, progress))
            end = received[-1]
            assert isinstance(end, FeedEnd)
            if not end.gone and (end.change, end.lineage) == (number, lineage):
                self.number = None  # until all of them are in
                for part in received:
                    if isinstance(part, Change):
                        _take(self.samples, part)
                self.number, self.lineage = number, lineage
                return
            self.resyncs += 1
        self._snapshot(bus, number, lineage, progress)

    def _snapshot(self, bus: Bus, number: int, lineage: str, progress: Callable[[], None]) -> None:
        self.samples, self.number = SampleStore(), None
        samples = SampleStore()
        for part in _received(bus, SNAPSHOT, SnapshotRequest(), progress):
            if isinstance(part, FeedEnd):
                if part.change < number or (part.change == number and part.lineage != lineage):
                    raise PeerSilent(
                        f"snapshot at change {part.change} of lineage {part.lineage}, "
                        f"expected {number} of {lineage}"
                    )
                self.samples, self.number, self.lineage = samples, part.change, part.lineage
            else:
                _take(samples, part)


def _received(
    bus: Bus, stream: Stream, request: Message, progress: Callable[[], None]
) -> Iterator[Change | FeedEnd]:
    """Yield the parts of a transfer and, last, its end. Raises PeerSilent if it is not complete."""
    rows = messages = 0
    for part in bus.request_many(stream, request, Change, FeedEnd, patience_s=PATIENCE_S):
        progress()
        if isinstance(part, FeedEnd):
            if (part.rows, part.messages) != (rows, messages):
                raise PeerSilent(
                    f"transfer incomplete: expected {part.rows} rows in {part.messages} parts, "
                    f"got {rows} in {messages}"
                )
            yield part
            return
        assert isinstance(part, Change)
        rows, messages = rows + part.count, messages + 1
        yield part
    raise PeerSilent(f"transfer broke off after {rows} rows in {messages} parts")


def _take(samples: SampleStore, part: Change) -> None:
    """Apply one part of a transfer. Raises PeerSilent when it does not fit."""
    try:
        apply(samples, part)
    except (KeyError, ValueError) as error:
        raise PeerSilent(f"change {part.number} does not fit the mirror: {error}") from error


def apply(samples: SampleStore, part: Change) -> None:
    """Apply one part of a change. Raises KeyError or ValueError when it does not fit."""
    values = columns.CHANGES[part.kind].decode(part)
    if part.kind == "discard":
        samples.remove(values["ids"])
    elif part.kind == "rewards":
        samples.set_rewards(values["ids"], values["rewards"])
    else:
        rows = np.zeros(len(values["ids"]), MIRROR)
        for column, name in (("id", "ids"), ("action", "actions"), ("reward", "rewards")):
            rows[column] = values[name]
        samples.append(rows, values["images"])
