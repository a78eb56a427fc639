"""The naive oracle of what a credential may do: one concrete key at a time, from the table."""

from __future__ import annotations

from services.security.kinds import Credential
from shared.keys import STREAMS, Stream

CREDENTIALS = (
    Credential("driver", ("alpha",)),
    Credential("driver", ("beta",)),
    Credential("actor"),
    Credential("actor", ("alpha",)),
    Credential("replay"),
    Credential("learner"),
    Credential("operator", ("anna",)),
    Credential("watcher"),
    Credential("pilot", ("beta",)),
)
ROBOTS = ("alpha", "beta")
SERVICES = ("driver-alpha", "driver-beta", "actor-main", "actor-alpha", "replay-main")
SERVICES = (*SERVICES, "learner-main", "recorder-main")


def idents(stream: Stream) -> tuple[str, ...]:
    """Ids with which a stream is tried."""
    if "{id}" not in stream.pattern:
        return ("main",)
    return SERVICES if "/service/" in stream.pattern else ROBOTS


PLACES = tuple((stream, ident) for stream in STREAMS for ident in idents(stream))
TOKEN_PLACES = (
    *(("driver", robot) for robot in ROBOTS),
    *(("actor", ident) for ident in ("main", *ROBOTS)),
    *((service, "main") for service in ("replay", "learner", "recorder")),
)


def may(who: Credential, action: str, stream: Stream, ident: str) -> bool:
    """Whether it may put, hear, ask or answer there."""
    for role in ("operator", "actor") if who.kind == "pilot" else (who.kind,):
        sends, receives = role in stream.senders, role in stream.receivers
        its_robot = role not in ("driver", "actor") or not who.names or ident in who.names
        own = near = "{id}" not in stream.pattern or its_robot
        if "/service/" in stream.pattern:
            kind, _, rest = ident.partition("-")
            main_only = role not in ("driver", "actor")
            own = kind == role and (rest == "main" if main_only else rest in (who.names or [rest]))
            near = True
        if action == "put" and sends and own:
            return True
        if action == "hear" and ((sends and own) or (receives and near)):
            return True
        if action == "answer" and receives and own:
            return True
        if action == "ask" and ((sends and near) or (receives and own)):
            return True
    return False


def may_announce(who: Credential, service: str, ident: str) -> bool:
    """Whether it may hold the token of this service."""
    if who.kind in ("operator", "watcher"):
        return service == "recorder"
    if who.kind in ("replay", "learner"):
        return service == who.kind
    return service == ("driver" if who.kind == "driver" else "actor") and (
        not who.names or ident in who.names
    )
