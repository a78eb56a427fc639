"""The newest heartbeat of every service, and how old each is."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from shared.inbox import Inbox
from shared.keys import ACTOR_STATE, LEARNER_STATE, REPLAY_STATE, ROBOT_STATE, Stream
from shared.messages import ActorState, LearnerState, Message, ReplayState, RobotState

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
    def everybody(self) -> dict[str, Seen[Any]]:
        """Every heartbeat, by what people call its sender."""
        return {
            **({"replay": self.replay} if self.replay else {}),
            **({"learner": self.learner} if self.learner else {}),
            **{f"robot {name}": seen for name, seen in self.robots.items()},
            **{f"actor of {name}": seen for name, seen in self.actors.items()},
        }

    @property
    def episodes_done(self) -> int:
        """Episodes through the whole loop: stored, trained on, checkpoint on disk."""
        return self.learner.message.episode if self.learner else 0

    @property
    def actions_per_s(self) -> float:
        """Actions of all robots together."""
        return sum(seen.message.actions_per_s for seen in self.actors.values())


class Reader:
    """Gathers heartbeats from an inbox. `update` often; `snapshot` when something is shown."""

    def __init__(
        self, inbox: Inbox, clock: Callable[[], float] = time.monotonic, robot: str = "*"
    ) -> None:
        """Listen to all robots, or to one: a driver's credentials allow no more."""
        self._inbox, self._clock = inbox, clock
        self._newest: dict[Stream, dict[str, tuple[Message, float]]] = {}
        inbox.subscribe(ROBOT_STATE, robot)
        for stream in (ACTOR_STATE, REPLAY_STATE, LEARNER_STATE):
            inbox.subscribe(stream)

    def update(self) -> None:
        """Take what has arrived."""
        now_s = self._clock()
        for stream in (ROBOT_STATE, ACTOR_STATE, REPLAY_STATE, LEARNER_STATE):
            newest = self._newest.setdefault(stream, {})
            newest.update((who, (m, now_s)) for who, m in self._inbox.take(stream, stream.request))

    def snapshot(self) -> Snapshot:
        """The newest of everything, with its age now."""
        now_s = self._clock()

        def seen(stream: Stream) -> dict[str, Seen[Any]]:
            newest = sorted(self._newest.get(stream, {}).items())
            return {name: Seen(message, now_s - at_s) for name, (message, at_s) in newest}

        return Snapshot(
            robots=seen(ROBOT_STATE),
            actors=seen(ACTOR_STATE),
            replay=next(iter(seen(REPLAY_STATE).values()), None),
            learner=next(iter(seen(LEARNER_STATE).values()), None),
        )
