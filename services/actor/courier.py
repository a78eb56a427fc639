"""Talks to replay beside the loop: what one robot waits for holds up no other robot."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from shared.keys import EPISODE, PROGRESS
from shared.messages import Episode, EpisodeAck, ProgressRequest, RobotProgress
from shared.service import Service

AT_ONCE = 4
"""Episodes on their way at the same time; each robot has one at most, the others' wait."""
REFUSALS = 3
"""So often a request must be refused for good until it is given up."""


@dataclass(frozen=True)
class Delivery:
    """What replay answered, and how often it was asked."""

    ack: EpisodeAck
    attempts: int


class Courier:
    """Asks until there is an answer; `notify` is called then, from a thread of the courier."""

    def __init__(self, me: Service, notify: Callable[[], None]) -> None:
        self._me, self._notify = me, notify
        self._pool = ThreadPoolExecutor(AT_ONCE, "courier")

    def send(self, episode: Episode) -> Future[Delivery]:
        """Begin to hand over an episode. The future raises Stopped, or PeerRefused for good."""
        future = self._pool.submit(self._deliver, episode)
        future.add_done_callback(lambda _: self._notify())
        return future

    def ask(self, robot: str) -> Future[RobotProgress]:
        """Begin to ask where a robot was. The future raises like that of `send`."""
        future = self._pool.submit(self._progress, robot)
        future.add_done_callback(lambda _: self._notify())
        return future

    def _progress(self, robot: str) -> RobotProgress:
        def attempt() -> RobotProgress:
            return self._me.bus.request(
                PROGRESS, ProgressRequest(robot=robot), RobotProgress, ident=robot
            )

        return self._me.insist("ask replay for the robot's progress", attempt, refusals=REFUSALS)

    def _deliver(self, episode: Episode) -> Delivery:
        attempts = 0

        def attempt() -> EpisodeAck:
            nonlocal attempts
            attempts += 1
            return self._me.bus.request(EPISODE, episode, EpisodeAck, ident=episode.robot)

        return Delivery(
            self._me.insist("hand an episode to replay", attempt, refusals=REFUSALS), attempts
        )
