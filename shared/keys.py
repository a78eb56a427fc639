"""The one table of streams: key, message types, who sends, who receives, how it is delivered.

Keys start with the run name, then the sender (`<run>/robot/<robot>/observation`), so that two runs
never mix and allow-lists per role stay short. There are two kinds of delivery and no third:

latest   published. The receiver holds one message per key, and a newer one replaces an unread
         older one. The next heartbeat or a repetition replaces a lost message.
request  the sender repeats it until it is answered or its deadline is over. The receiver's queue
         is bounded; what does not fit is answered with the error "busy".
"""

import re
from dataclasses import dataclass
from typing import Literal

from shared import messages as m
from shared.errors import BadMessage
from shared.facts import NAME

KIB = 1024
MIB = 1024 * 1024


Role = Literal["driver", "actor", "replay", "learner", "operator", "watcher"]
"""Who may be on the bus. An operator is a person with tools that command; a watcher only reads."""
LOOKING: tuple[Role, ...] = ("operator", "watcher")
SERVING: tuple[Role, ...] = ("driver", "actor", "replay", "learner")
ALL: tuple[Role, ...] = (*SERVING, *LOOKING)


@dataclass(frozen=True)
class Stream:
    """One row of the table. Its pattern holds `{run}` and, where several may exist, `{id}`."""

    name: str
    pattern: str
    request: type[m.Message]
    """What is published, or the payload of a request."""
    reply: tuple[type[m.Message], ...]
    """Types of the answers; empty: it is published."""
    senders: tuple[Role, ...]
    """Who publishes or asks."""
    receivers: tuple[Role, ...]
    """Who subscribes or answers."""
    rate: str
    max_bytes: int
    """Larger payloads are refused before they are decoded (of a request or a publication)."""
    queue: int = 1
    """Bound of the receiver's queue: 1 for latest."""

    @property
    def delivery(self) -> Literal["latest", "request"]:
        """How it is delivered."""
        return "request" if self.reply else "latest"

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


def check_sender(stream: Stream, ident: str, message: m.Message) -> None:
    """Raise BadMessage if a message tells of another robot than the one whose key it came by."""
    if getattr(message, "robot", ident) != ident and "{id}" in stream.pattern:
        kind = type(message).__name__
        raise BadMessage(
            f"{kind} of {getattr(message, 'robot', '')!r:.60} under the key of {ident}"
        )


# fmt: off
# Published: the receiver holds the newest of each key.
#                      name             key                             message          none from         to                               rate                                                 at most
OBSERVATION   = Stream("observation",   "{run}/robot/{id}/observation", m.Observation,   (), ("driver",),  ("actor", *LOOKING),            "one per action",                                    8 * KIB)
ACTION        = Stream("action",        "{run}/actor/{id}/action",      m.Action,        (), ("actor",),   ("driver", *LOOKING),           "one per observation",                               2 * KIB)
TAKEOVER      = Stream("takeover",      "{run}/takeover/{id}",          m.Takeover,      (), ("operator",), ("actor",),                    "10 Hz while a person drives",                       1 * KIB)
ROBOT_STATE   = Stream("robot_state",   "{run}/robot/{id}/state",       m.RobotState,    (), ("driver",),  LOOKING,                        "1 Hz",                                              4 * KIB)
ACTOR_STATE   = Stream("actor_state",   "{run}/actor/{id}/state",       m.ActorState,    (), ("actor",),   LOOKING,                        "1 Hz",                                              4 * KIB)
REPLAY_STATE  = Stream("replay_state",  "{run}/replay/main/state",      m.ReplayState,   (), ("replay",),  ("learner", "actor", *LOOKING), "1 Hz and at every turn",                            4 * KIB)
LEARNER_STATE = Stream("learner_state", "{run}/learner/main/state",     m.LearnerState,  (), ("learner",), ("actor", "replay", *LOOKING),  "1 Hz, 4 Hz while training, and at every turn done", 4 * KIB)

# Asked for and answered.
#                     name            key                               request             answers                from (asks)                    to (answers)  rate                              at most   queue
HALT         = Stream("halt",         "{run}/halt",                     m.Halts,            (m.Standing,),         (*SERVING, "operator"),        SERVING,      "until all stand, then 1 Hz",     8 * KIB,  64)
RELEASE      = Stream("release",      "{run}/release",                  m.Release,          (m.Standing,),         ("operator",),                 SERVING,      "rare",                           16 * KIB, 16)
ROBOT_WORLD  = Stream("robot_world",  "{run}/robot/{id}/world",         m.WorldChange,      (m.WorldChanged,),     ("operator",),                 ("driver",),  "rare",                           1 * KIB,  16)
EPISODE      = Stream("episode",      "{run}/replay/main/episode/{id}", m.Episode,          (m.EpisodeAck,),       ("actor",),                    ("replay",),  "one per episode",                24 * MIB, 16)
PROGRESS     = Stream("progress",     "{run}/replay/main/progress/{id}", m.ProgressRequest, (m.RobotProgress,),    ("actor",),                    ("replay",),  "at start",                       1 * KIB,  16)
TURNS        = Stream("turns",        "{run}/replay/main/turns",        m.TurnsRequest,     (m.Turns,),            ("learner",),                  ("replay",),  "one per turn",                   1 * KIB,  16)
CHANGES      = Stream("changes",      "{run}/replay/main/changes",      m.ChangesRequest,   (m.Change, m.FeedEnd), ("learner",),                  ("replay",),  "one per turn",                   1 * KIB,  4)
SNAPSHOT     = Stream("snapshot",     "{run}/replay/main/snapshot",     m.SnapshotRequest,  (m.Change, m.FeedEnd), ("learner",),                  ("replay",),  "at start and after a gap",       1 * KIB,  4)
MINI_BATCH   = Stream("mini_batch",   "{run}/replay/main/mini_batch",   m.MiniBatchRequest, (m.Change,),           ("learner",),                  ("replay",),  "any",                            1 * KIB,  4)
WEIGHTS      = Stream("weights",      "{run}/learner/main/weights",     m.WeightsRequest,   (m.Weights,),          ("actor", "replay", *LOOKING), ("learner",), "one per version",                1 * KIB,  16)
PING         = Stream("ping",         "{run}/service/{id}/ping",        m.Ping,             (m.ServiceReply,),     ALL,                           SERVING,      "rare",                           1 * KIB,  16)
STOP         = Stream("stop",         "{run}/service/{id}/stop",        m.StopService,      (m.ServiceReply,),     ("operator",),                 SERVING,      "rare",                           1 * KIB,  16)

STREAMS: tuple[Stream, ...] = (
    OBSERVATION, ACTION, TAKEOVER, HALT, RELEASE, ROBOT_STATE, ROBOT_WORLD, ACTOR_STATE,
    EPISODE, PROGRESS, REPLAY_STATE, TURNS, CHANGES, SNAPSHOT, MINI_BATCH,
    LEARNER_STATE, WEIGHTS, PING, STOP,
)
# fmt: on

ALIVE_PATTERN = "{run}/alive/{service}/{id}/{life}/{protocol}/{config}"
"""Liveliness token of every service: who is there, which protocol and configuration it speaks."""
_PLAIN = re.compile(r"[A-Za-z0-9_-]{1,64}")
"""What a part of a token may look like: strangers' parts are shown on terminals."""
CLAIM_PATTERN = "{run}/claim/{service}/{id}/{life}"
"""Liveliness token of a process that wants a role (`shared.roles`)."""


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
    if len(chunks) != 7 or chunks[1] != "alive" or not all(map(_PLAIN.fullmatch, chunks[2:])):
        return None
    return Peer(*chunks[2:])
