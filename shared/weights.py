"""Weights over the bus: cut into parts, fetched by version beside the service's own work."""

from __future__ import annotations

import hashlib
import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import torch

from shared.complaints import Complaints
from shared.errors import BadMessage, BusError, PeerSilent
from shared.keys import LEARNER_STATE, WEIGHTS
from shared.messages import LearnerState, Weights, WeightsRequest
from shared.rl.network import MAX_WEIGHT_BYTES, QNetwork, checked
from shared.service import TICK_S, Service, Stopped

if TYPE_CHECKING:
    from shared.bus import Bus

PART_BYTES = 1024 * 1024
PATIENCE_S = 5.0
"""Longest that a part of a transfer takes to come."""
RETRY_S = 0.05
LONGEST_RETRY_S = 10.0
"""Period of asking for a version that is announced but not delivered, or refused."""
log = logging.getLogger(__name__)


def parts(version: int, data: bytes, digest: str) -> Iterator[Weights]:
    """One version of the target network as messages of about 1 MB; digest: its `weights_hash`."""
    chunks = [data[i : i + PART_BYTES] for i in range(0, len(data), PART_BYTES)]
    for part, chunk in enumerate(chunks):
        yield Weights(version=version, hash=digest, part=part, parts=len(chunks), data=chunk)


def fetch(bus: Bus, *, everybody: bool = False) -> tuple[int, bytes]:
    """The newest version and its safetensors bytes. Raises BusError or BadMessage."""
    received, digest, size = [], hashlib.sha256(), 0
    replies = bus.request_many(
        WEIGHTS, WeightsRequest(), Weights, patience_s=PATIENCE_S, everybody=everybody
    )
    for message in replies:
        digest.update(message.data)  # while the next part is on its way
        received.append(message)
        size += len(message.data)
        if everybody and len(received) == message.parts:
            break  # whoever is asked beside is not waited for
        if size > MAX_WEIGHT_BYTES or len(received) > message.parts:
            raise BadMessage(f"weights: more than {message.parts} parts or too many bytes")
    first = received[0]
    if [m.part for m in received] != list(range(first.parts)):
        raise PeerSilent(f"weights: expected {first.parts} parts, got {len(received)}")
    if {(m.version, m.hash) for m in received} != {(first.version, digest.hexdigest()[:16])}:
        raise BadMessage(f"weights: parts of version {first.version} do not match their hash")
    return first.version, b"".join(message.data for message in received)


class Wanted:
    """Which version to ask for, and when: ever more rarely for what is announced and not there."""

    def __init__(self) -> None:
        self.version = 1
        self._period_s, self._next_s = RETRY_S, 0.0

    def note(self, version: int) -> None:
        """Take the newest announcement, which may say less than the one before."""
        if version != self.version:
            self.version, self._period_s, self._next_s = version, RETRY_S, 0.0

    def due_s(self, now_s: float) -> float:
        """How long to wait before it is asked for again; 0 for now."""
        return max(self._next_s - now_s, 0.0)

    def missed(self, now_s: float, *, answered: bool) -> bool:
        """It did not come. answered: something came in its place. Whether that lasts for long."""
        self._next_s = now_s + self._period_s
        if answered:
            self._period_s = min(2.0 * self._period_s, LONGEST_RETRY_S)
        return self._period_s == LONGEST_RETRY_S


class WeightsFetcher(threading.Thread):
    """Holds the newest target network; a learner that does not answer holds up nobody.

    What does not fit the network is refused. `notify` is called from this thread for a newer one.
    """

    def __init__(self, me: Service, notify: Callable[[], None]) -> None:
        super().__init__(name="weights", daemon=True)
        self._me, self._notify = me, notify
        with torch.device("meta"):  # names and shapes without values
            self._network = QNetwork(me.config.network)
        self._inbox = me.bus.inbox()
        self._inbox.subscribe(LEARNER_STATE, "main")
        self._inbox.watch("learner", "main")
        self._newer = threading.Condition()
        self.newest: tuple[int, bytes] = (0, b"")
        """Version and safetensors bytes; version 0 before anything came."""
        self._wanted = Wanted()
        self._silent = False
        """The router has chosen somebody who does not answer, such as a learner that is gone."""
        self._complaints = Complaints(log.warning)
        self.refused = 0
        """Answers that were no weights of this run's network."""
        self.heard: tuple[int, float] = (0, -float("inf"))
        """Version that the newest announcement named, and when it came (`time.monotonic`)."""
        me.stop.on_set(self._inbox.wake)
        self.start()

    def wait_for(self, least: int) -> tuple[int, bytes]:
        """The newest weights, as soon as their version is at least this. Raises Stopped."""
        with self._newer:
            while self.newest[0] < least:
                if self._me.stop.is_set():
                    raise Stopped("waiting for weights")
                self._newer.wait(TICK_S)
        return self.newest

    def run(self) -> None:
        """Fetch whatever the learner announces, until the service stops."""
        wanted = self._wanted
        while not self._me.stop.is_set():
            waiting_s = wanted.due_s(time.monotonic())
            if wanted.version <= self.newest[0] or waiting_s:
                self._inbox.wait(min(waiting_s or TICK_S, TICK_S))
            for _, state in self._inbox.take(LEARNER_STATE, LearnerState):
                lives = self._inbox.lives("learner", "main")
                if not lives or state.life in lives:
                    wanted.note(state.weights_version)
                    self.heard = (state.weights_version, time.monotonic())
            if wanted.version > self.newest[0] and not wanted.due_s(time.monotonic()):
                self._fetch()

    def _fetch(self) -> None:
        """One attempt to have something newer."""
        try:
            version, data = fetch(self._me.bus, everybody=self._silent)
            checked(self._network, data)
        except BusError as error:
            log.debug("weights not fetched: %s", error)
            self._silent = isinstance(error, PeerSilent)
            self._wanted.missed(time.monotonic(), answered=False)
            return
        except (BadMessage, ValueError) as error:
            self.refused += 1
            self._wanted.missed(time.monotonic(), answered=True)
            self._complaints.tell("refused", f"weights refused, the older ones stay: {error}")
            return
        if self.newest[0] < version <= self._wanted.version + 1:  # it may be about to tell
            with self._newer:
                self.newest = (version, data)
                self._newer.notify_all()
            self._notify()
        if self._wanted.version > self.newest[0] and self._wanted.missed(
            time.monotonic(), answered=True
        ):
            told = f"weights version {self._wanted.version} is announced, but {version} is served"
            self._complaints.tell("missing", told)
