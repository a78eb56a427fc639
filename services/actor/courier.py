"""Hands episodes to replay beside the loop: one robot's episode holds up no other robot."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from shared.keys import EPISODE
from shared.messages import Episode, EpisodeAck
from shared.service import Service

AT_ONCE = 4
"""Episodes on their way at the same time; each robot has one at most, the others' wait."""


@dataclass(frozen=True)
class Delivery:
    """What replay answered, and how often it was asked."""

    ack: EpisodeAck
    attempts: int


class Courier:
    """Sends an episode until it is acknowledged; `notify` is called then, from its own thread."""

    def __init__(self, me: Service, notify: Callable[[], None]) -> None:
        self._me, self._notify = me, notify
        self._pool = ThreadPoolExecutor(AT_ONCE, "courier")

    def send(self, episode: Episode) -> Future[Delivery]:
        """Begin to hand over an episode. The future raises Stopped when the service stops first."""
        future = self._pool.submit(self._deliver, episode)
        future.add_done_callback(lambda _: self._notify())
        return future

    def _deliver(self, episode: Episode) -> Delivery:
        attempts = 0

        def attempt() -> EpisodeAck:
            nonlocal attempts
            attempts += 1
            return self._me.bus.request(EPISODE, episode, EpisodeAck)

        return Delivery(self._me.insist("hand an episode to replay", attempt), attempts)
