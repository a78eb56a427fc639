"""The one table of streams: key, message types, who sends, who receives, how it is delivered.

Keys start with the run name, then the sender (`<run>/robot/<robot>/observation`), so that two runs
never mix and allow-lists per role stay short. `docs/protocol.md` is checked against this table by
a test. There are two kinds of delivery and no third:

latest   published; the receiver holds one message per key, a newer one replaces an unread older
         one. A lost message is repaired by the next heartbeat or by sending again.
request  asked for and answered; the asker repeats until answered or its deadline is over. The
         server's queue is bounded; what does not fit is answered with the error "busy".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from shared import messages as m
from shared.facts import NAME

KIB = 1024
MIB = 1024 * 1024


@dataclass(frozen=True)
class Stream:
    """One row of the table.

    pattern holds `{run}` and, where several of a kind may exist, `{id}`. `request` is the type a
    published stream carries, or the type of a request's payload; `reply` the type of its answers.
    """

    name: str
    pattern: str
    delivery: Literal["latest", "request"]
    request: type[m.Message]
    reply: tuple[type[m.Message], ...]
    sender: str
    receiver: str
    rate: str
    max_bytes: int
    """Larger payloads are refused before they are decoded (of a request or a publication)."""
    queue: int
    """Bound of the receiver's queue: 1 for latest."""
    overflow: str

    def key(self, run: str, ident: str = "") -> str:
        """The concrete key. Raises ValueError for a name that could widen the key."""
        for chunk in (run, *([ident] if "{id}" in self.pattern else [])):
            if not NAME.fullmatch(chunk):
                raise ValueError(
                    f"key {self.pattern}: expected a name like {NAME.pattern}, got {chunk!r}"
                )
        return self.pattern.format(run=run, id=ident)

    def wildcard(self, run: str) -> str:
        """The key expression that matches every sender's instance."""
        return self.pattern.format(run=run, id="*")


def ident_in(stream: Stream, key: str) -> str | None:
    """The id in a concrete key; None for wildcards and foreign forms, "main" for none."""
    pattern, chunks = stream.pattern.split("/"), key.split("/")
    if len(pattern) != len(chunks):
        return None
    ident = "main"
    for expected, chunk in zip(pattern, chunks, strict=True):
        if not NAME.fullmatch(chunk) or (not expected.startswith("{") and chunk != expected):
            return None
        if expected == "{id}":
            ident = chunk
    return ident


NEWEST = "newer replaces unread older"
BUSY = "error reply 'busy', the asker repeats"

OBSERVATION = Stream(
    "observation",
    "{run}/robot/{id}/observation",
    "latest",
    m.Observation,
    (),
    "robot_driver",
    "actor, monitor",
    "one per action",
    8 * KIB,
    1,
    NEWEST,
)
ACTION = Stream(
    "action",
    "{run}/actor/{id}/action",
    "latest",
    m.Action,
    (),
    "actor",
    "robot_driver, monitor",
    "one per observation",
    2 * KIB,
    1,
    NEWEST,
)
ROBOT_STATE = Stream(
    "robot_state",
    "{run}/robot/{id}/state",
    "latest",
    m.RobotState,
    (),
    "robot_driver",
    "monitor",
    "1 Hz",
    4 * KIB,
    1,
    NEWEST,
)
ROBOT_COMMAND = Stream(
    "robot_command",
    "{run}/robot/{id}/command",
    "request",
    m.RobotCommand,
    (m.RobotState,),
    "anyone",
    "robot_driver",
    "rare",
    1 * KIB,
    16,
    BUSY,
)
ROBOT_WORLD = Stream(
    "robot_world",
    "{run}/robot/{id}/world",
    "request",
    m.WorldChange,
    (m.WorldChanged,),
    "anyone",
    "robot_driver",
    "rare",
    1 * KIB,
    16,
    BUSY,
)
ACTOR_STATE = Stream(
    "actor_state",
    "{run}/actor/{id}/state",
    "latest",
    m.ActorState,
    (),
    "actor",
    "monitor",
    "1 Hz",
    4 * KIB,
    1,
    NEWEST,
)
EPISODE = Stream(
    "episode",
    "{run}/replay/main/episode",
    "request",
    m.Episode,
    (m.EpisodeAck,),
    "actor",
    "replay",
    "one per episode",
    24 * MIB,
    16,
    BUSY,
)
PROGRESS = Stream(
    "progress",
    "{run}/replay/main/progress",
    "request",
    m.ProgressRequest,
    (m.RobotProgress,),
    "actor",
    "replay",
    "at start",
    1 * KIB,
    16,
    BUSY,
)
REPLAY_STATE = Stream(
    "replay_state",
    "{run}/replay/main/state",
    "latest",
    m.ReplayState,
    (),
    "replay",
    "learner, actor, monitor",
    "1 Hz and at every turn",
    4 * KIB,
    1,
    NEWEST,
)
TURNS = Stream(
    "turns",
    "{run}/replay/main/turns",
    "request",
    m.TurnsRequest,
    (m.Turns,),
    "learner",
    "replay",
    "one per turn",
    1 * KIB,
    16,
    BUSY,
)
CHANGES = Stream(
    "changes",
    "{run}/replay/main/changes",
    "request",
    m.ChangesRequest,
    (m.Change, m.FeedEnd),
    "learner",
    "replay",
    "one per turn",
    1 * KIB,
    4,
    BUSY,
)
SNAPSHOT = Stream(
    "snapshot",
    "{run}/replay/main/snapshot",
    "request",
    m.SnapshotRequest,
    (m.Change, m.FeedEnd),
    "learner",
    "replay",
    "at start and after a gap",
    1 * KIB,
    4,
    BUSY,
)
MINI_BATCH = Stream(
    "mini_batch",
    "{run}/replay/main/mini_batch",
    "request",
    m.MiniBatchRequest,
    (m.Change,),
    "a foreign learner",
    "replay",
    "as it likes",
    1 * KIB,
    4,
    BUSY,
)
LEARNER_STATE = Stream(
    "learner_state",
    "{run}/learner/main/state",
    "latest",
    m.LearnerState,
    (),
    "learner",
    "actor, replay, monitor",
    "1 Hz, 4 Hz while training, and at every turn done",
    4 * KIB,
    1,
    NEWEST,
)
WEIGHTS = Stream(
    "weights",
    "{run}/learner/main/weights",
    "request",
    m.WeightsRequest,
    (m.Weights,),
    "actor, replay, anyone",
    "learner",
    "one per version",
    1 * KIB,
    16,
    BUSY,
)
SERVICE = Stream(
    "service",
    "{run}/service/{id}/command",
    "request",
    m.ServiceCommand,
    (m.ServiceReply,),
    "anyone",
    "every service",
    "rare",
    1 * KIB,
    16,
    BUSY,
)

STREAMS: tuple[Stream, ...] = (
    OBSERVATION, ACTION, ROBOT_STATE, ROBOT_COMMAND, ROBOT_WORLD, ACTOR_STATE,
    EPISODE, PROGRESS, REPLAY_STATE, TURNS, CHANGES, SNAPSHOT, MINI_BATCH,
    LEARNER_STATE, WEIGHTS, SERVICE,
)  # fmt: skip

ALIVE_PATTERN = "{run}/alive/{service}/{id}/{life}/{protocol}/{config}"
"""Liveliness token of every service: who is there, which protocol and configuration it speaks."""


def alive_key(run: str, service: str, ident: str, life: str, protocol: int, config: str) -> str:
    """Key of one service's liveliness token."""
    return ALIVE_PATTERN.format(
        run=run, service=service, id=ident, life=life, protocol=protocol, config=config
    )


@dataclass(frozen=True)
class Peer:
    """A living service, as its liveliness token tells."""

    service: str
    id: str
    life: str
    protocol: str
    config: str


def parse_alive(key: str) -> Peer | None:
    """The peer behind a liveliness key, or None if it has another form."""
    chunks = key.split("/")
    if len(chunks) != 7 or chunks[1] != "alive":
        return None
    return Peer(*chunks[2:])
