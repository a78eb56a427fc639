"""Weights over the bus: cut into parts, fetched by version beside the service's own work."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from shared.errors import BadMessage, BusError, PeerSilent
from shared.keys import LEARNER_STATE, WEIGHTS
from shared.messages import LearnerState, Weights, WeightsRequest
from shared.rl.network import WeightsHash
from shared.service import TICK_S, Service, Stopped

if TYPE_CHECKING:
    from shared.bus import Bus

PART_BYTES = 1024 * 1024
RETRY_S = 0.05
log = logging.getLogger(__name__)


def parts(version: int, data: bytes, digest: str) -> Iterator[Weights]:
    """One version of the target network as messages of about 1 MB; digest: its `weights_hash`."""
    chunks = [data[i : i + PART_BYTES] for i in range(0, len(data), PART_BYTES)]
    for part, chunk in enumerate(chunks):
        yield Weights(version=version, hash=digest, part=part, parts=len(chunks), data=chunk)


def fetch(bus: Bus) -> tuple[int, bytes]:
    """The newest version and its safetensors bytes. Raises BusError or BadMessage."""
    received, digest = [], WeightsHash()
    for message in bus.request_many(WEIGHTS, WeightsRequest(), Weights):
        digest.add(message.data)  # while the next part is on its way
        received.append(message)
    first = received[0]
    if [m.part for m in received] != list(range(first.parts)):
        raise PeerSilent(f"weights: expected {first.parts} parts, got {len(received)}")
    if {(m.version, m.hash) for m in received} != {(first.version, digest.text)}:
        raise BadMessage(f"weights: parts of version {first.version} do not match their hash")
    return first.version, b"".join(message.data for message in received)


class WeightsFetcher(threading.Thread):
    """Holds the newest target network; a learner that does not answer holds up nobody.

    `notify` is called whenever there is a newer version (from this thread).
    """

    def __init__(self, me: Service, notify: Callable[[], None]) -> None:
        super().__init__(name="weights", daemon=True)
        self._me, self._notify = me, notify
        self._inbox = me.bus.inbox()
        self._inbox.subscribe(LEARNER_STATE, "main")
        self._newer = threading.Condition()
        self._newest: tuple[int, bytes] = (0, b"")
        self.refused = 0
        me.stop.on_set(self._inbox.wake)
        self.start()

    @property
    def newest(self) -> tuple[int, bytes]:
        """Version and safetensors bytes; version 0 before anything came."""
        return self._newest

    def wait_for(self, least: int) -> tuple[int, bytes]:
        """The newest weights, as soon as their version is at least this. Raises Stopped."""
        with self._newer:
            while self._newest[0] < least:
                if self._me.stop.is_set():
                    raise Stopped("waiting for weights")
                self._newer.wait(TICK_S)
        return self._newest

    def run(self) -> None:
        """Fetch whatever the learner announces, until the service stops."""
        announced = 1
        while not self._me.stop.is_set():
            if announced <= self._newest[0]:
                self._inbox.wait(TICK_S)
            for _, state in self._inbox.take(LEARNER_STATE, LearnerState):
                announced = max(announced, state.weights_version)
            if announced > self._newest[0] and not self._fetch():
                self._me.stop.wait(RETRY_S)

    def _fetch(self) -> bool:
        """One attempt; whether anything newer came."""
        try:
            version, data = fetch(self._me.bus)
        except (BusError, BadMessage) as error:
            log.debug("weights not fetched: %s", error)
            return False
        if version <= self._newest[0]:
            return False
        with self._newer:
            self._newest = (version, data)
            self._newer.notify_all()
        self._notify()
        return True
