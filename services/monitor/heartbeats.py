"""The newest heartbeat of every service, and how old each is."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

from shared.keys import ACTOR_STATE, LEARNER_STATE, REPLAY_STATE, ROBOT_STATE, Stream
from shared.messages import ActorState, LearnerState, Message, ReplayState, RobotState

M = TypeVar("M", bound=Message)
M_co = TypeVar("M_co", bound=Message, covariant=True)


@dataclass(frozen=True)
class Seen(Generic[M_co]):
    """A message and how long ago it came."""

    message: M_co
    age_s: float


@dataclass(frozen=True)
class Snapshot:
    """What all services last told; empty or None: nothing yet."""

    robots: Mapping[str, Seen[RobotState]] = field(default_factory=dict)
    actors: Mapping[str, Seen[ActorState]] = field(default_factory=dict)
    replay: Seen[ReplayState] | None = None
    learner: Seen[LearnerState] | None = None

    @property
    def episodes_done(self) -> int:
        """Episodes through the whole loop: stored, trained on, checkpoint on disk."""
        return self.learner.message.episode if self.learner else 0

    @property
    def actions_per_s(self) -> float:
        """Actions of all robots together."""
        return sum(seen.message.actions_per_s for seen in self.actors.values())


class Source(Protocol):
    """What the reader needs of an inbox."""

    def subscribe(self, stream: Stream, ident: str = "*") -> None:
        """Keep the newest message of every sender."""

    def take(self, stream: Stream, cls: type[M]) -> list[tuple[str, M]]:
        """The newest unread messages by sender."""


class Reader:
    """Gathers heartbeats from an inbox. `update` often; `snapshot` when something is shown."""

    def __init__(
        self, inbox: Source, clock: Callable[[], float] = time.monotonic, robot: str = "*"
    ) -> None:
        """Listen to all robots, or to one: a driver's credentials allow no more."""
        self._inbox, self._clock = inbox, clock
        self._robots: dict[str, tuple[RobotState, float]] = {}
        self._actors: dict[str, tuple[ActorState, float]] = {}
        self._replay: tuple[ReplayState, float] | None = None
        self._learner: tuple[LearnerState, float] | None = None
        inbox.subscribe(ROBOT_STATE, robot)
        for stream in (ACTOR_STATE, REPLAY_STATE, LEARNER_STATE):
            inbox.subscribe(stream)

    def update(self) -> None:
        """Take what has arrived."""
        now_s = self._clock()
        for sender, robot in self._inbox.take(ROBOT_STATE, RobotState):
            self._robots[sender] = (robot, now_s)
        for sender, actor in self._inbox.take(ACTOR_STATE, ActorState):
            self._actors[sender] = (actor, now_s)
        for _, replay in self._inbox.take(REPLAY_STATE, ReplayState):
            self._replay = (replay, now_s)
        for _, learner in self._inbox.take(LEARNER_STATE, LearnerState):
            self._learner = (learner, now_s)

    def snapshot(self) -> Snapshot:
        """The newest of everything, with its age now."""
        now_s = self._clock()

        def seen(pair: tuple[M, float]) -> Seen[M]:
            return Seen(pair[0], now_s - pair[1])

        return Snapshot(
            robots={name: seen(pair) for name, pair in sorted(self._robots.items())},
            actors={name: seen(pair) for name, pair in sorted(self._actors.items())},
            replay=seen(self._replay) if self._replay else None,
            learner=seen(self._learner) if self._learner else None,
        )
