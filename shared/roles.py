"""One process for each role: (run, service, id) belongs to one process at a time.

On one machine the lock on a file of the run folder decides. Between machines a claim on the bus
decides: a process first announces that it wants the role, then looks, and goes on only if nobody
holds it; of several who want it the lowest life gets it. The one that looks second always sees the
one that announced first. A holder that is gone, or frozen, loses the role with its lease. One that
was cut off when another one looked is not seen: of two that meet afterwards the older one stays.
"""

from __future__ import annotations

import fcntl
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from shared.errors import RoleTaken
from shared.keys import PING
from shared.messages import Ping, ServiceReply

if TYPE_CHECKING:
    from shared.bus import Bus

POLL_S, PING_S, MARGIN_S = 0.02, 0.5, 0.5
ALIKE_S = 1.0
"""Ages that differ by less are alike: each process learns of the other's a little later."""


@contextmanager
def locked(folder: Path, service: str, ident: str, life: str) -> Iterator[None]:
    """Hold the lock of a role in a run folder. Raises RoleTaken, which names the holder."""
    path = folder / "roles" / f"{service}-{ident}.lock"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+") as stream:
        try:
            fcntl.flock(stream.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            stream.seek(0)
            holder = stream.read().strip() or "a process that starts now"
            raise RoleTaken(f"{service} {ident!r} of {folder} is held by {holder}") from None
        stream.truncate(0)
        stream.write(f"{socket.gethostname()}, process {os.getpid()}, life {life}\n")
        stream.flush()
        yield


@contextmanager
def claimed(bus: Bus, service: str, ident: str, life: str) -> Iterator[None]:
    """Win a role on the bus; let the block announce the holder. Raises RoleTaken."""
    deadline_s = time.monotonic() + bus.config.lease_ms / 1000 + MARGIN_S
    with bus.claiming(service, ident, life):
        while (rival := _rival(bus, service, ident, life)) is not None:
            if rival:
                raise RoleTaken(f"{service} {ident!r} of run {bus.run!r} is held by {rival}")
            if time.monotonic() > deadline_s:
                raise RoleTaken(
                    f"{service} {ident!r} of run {bus.run!r} is held by a process that does not "
                    f"answer"
                )
            time.sleep(POLL_S)
        yield


def holder(bus: Bus, service: str, ident: str, life: str) -> str | None:
    """Who else has the role: host, process and life; empty if it does not answer, None: nobody."""
    others = [peer.life for peer in bus.peers(service, ident) if peer.life != life]
    if not others:
        return None
    inbox, until_s = bus.inbox(), time.monotonic() + PING_S
    inbox.ask_all(PING, Ping(), ident=f"{service}-{ident}", timeout_s=PING_S)
    while (left_s := until_s - time.monotonic()) > 0:
        inbox.wait(left_s)
        for reply in inbox.answers(ServiceReply):
            if reply.life in others:
                return f"{reply.host}, process {reply.pid}, life {reply.life}"
    return ""


def older(other: ServiceReply, own: ServiceReply) -> bool:
    """Whether the other one of two processes has their role for longer; the lower life if alike."""
    ahead_s = other.uptime_s - own.uptime_s
    return ahead_s > ALIKE_S or (ahead_s > -ALIKE_S and other.life < own.life)


def _rival(bus: Bus, service: str, ident: str, life: str) -> str | None:
    """Who is in the way: named, or empty if that will soon be clear. None: nobody."""
    wanting = bus.claims(service, ident) - {life}
    holding = holder(bus, service, ident, life)  # looked for last: who wins, holds before it stops
    if holding is None and wanting:
        lowest = min(wanting)
        return "" if life < lowest else f"a process that starts at the same time, life {lowest}"
    return holding
