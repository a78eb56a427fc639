"""`corridor status`: who is alive in a run, and what each last told about itself."""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import typer
from rich import box
from rich.console import Console, Group, RenderableType
from rich.table import Table

from services.monitor.heartbeats import Reader, Snapshot
from services.monitor.words import (
    by_action,
    duration,
    fitness,
    learner_doing,
    replay_doing,
    retention,
)
from services.processes import ACTOR, BY_NAME, DRIVER, LEARNER, REPLAY
from shared.bus import Bus
from shared.config import Config
from shared.errors import BadMessage, BusError, meant
from shared.keys import PING, Peer
from shared.messages import Ping, ServiceReply

PING_S = 1.0
WIDE = 78
"""Columns that the whole table of services needs."""
HEARTBEATS = 2.5
"""How many periods to wait for the heartbeats of those who are there."""


@dataclass(frozen=True)
class Entry:
    """One service that is alive, and its answer to a ping."""

    peer: Peer
    reply: ServiceReply | None
    """None: it did not answer."""


def show(config: Config, *, as_json: bool, require: Sequence[str]) -> int:
    """Print the state of a run; 0, or 1 if a service of `require` does not answer.

    Raises RouterMissing.
    """
    entries, snapshot = look(config)
    if as_json:
        typer.echo(json.dumps(as_dict(config, entries, snapshot), indent=2))
    else:
        console = Console(markup=False, emoji=False)
        console.print(report(config, entries, snapshot, narrow=console.width < WIDE))
    answering = {entry.peer.service for entry in entries if entry.reply is not None}
    missing = [name for name in require if name not in answering]
    if missing:
        hint = meant(missing[0], answering | BY_NAME.keys())
        typer.echo(f"corridor: no answer from {', '.join(missing)}{hint}", err=True)
    return 1 if missing else 0


def look(config: Config) -> tuple[list[Entry], Snapshot]:
    """Who is there, and the heartbeats of all of them. Raises RouterMissing."""
    with Bus(config.bus, config.run.name) as bus:
        reader = Reader(inbox := bus.inbox())
        entries = [Entry(peer, _ping(bus, peer)) for peer in bus.peers()]
        deadline_s = time.monotonic() + HEARTBEATS * config.bus.heartbeat_s
        while not _complete(entries, reader.snapshot()) and time.monotonic() < deadline_s:
            inbox.wait(0.1)
            reader.update()
        return entries, reader.snapshot()


def as_dict(config: Config, entries: Sequence[Entry], snapshot: Snapshot) -> dict[str, Any]:
    """Everything known, ready for JSON."""
    replay, learner = snapshot.replay, snapshot.learner
    return {
        "run": config.run.name,
        "endpoint": config.bus.endpoint,
        "services": [
            {
                **vars(entry.peer),
                "answers": entry.reply is not None,
                **{key: getattr(entry.reply, key, None) for key in ("pid", "version", "uptime_s")},
            }
            for entry in entries
        ],
        "robots": {name: seen.message.model_dump() for name, seen in snapshot.robots.items()},
        "actors": {name: seen.message.model_dump() for name, seen in snapshot.actors.items()},
        "replay": replay.message.model_dump() if replay else None,
        "learner": learner.message.model_dump() if learner else None,
    }


def report(
    config: Config, entries: Sequence[Entry], snapshot: Snapshot, *, narrow: bool = False
) -> RenderableType:
    """Everything known, as tables; narrow: for a terminal of less than `WIDE` columns."""
    title = f"run {config.run.name} at {config.bus.endpoint}"
    if not entries:
        return f"{title}: no service is alive"
    facts = Table.grid(padding=(0, 2))
    for row in _facts(snapshot):
        facts.add_row(*row)
    return Group(_services(title, entries, narrow), *([facts] if facts.row_count else []))


def _services(title: str, entries: Sequence[Entry], narrow: bool) -> Table:
    table = Table(title=title, title_justify="left", box=None if narrow else box.HEAVY_HEAD)
    columns = ("service", "id", "pid", "up", "version", "life", "config")
    for column in columns[: 4 if narrow else None]:
        table.add_column(column, no_wrap=True)
    for entry in entries:
        peer, reply = entry.peer, entry.reply
        told = (
            (str(reply.pid), duration(reply.uptime_s), reply.version)
            if reply
            else ("-", "no answer", "-")
        )
        row = (peer.service, peer.id, *told, peer.life, peer.config[:8])
        table.add_row(*row[: len(table.columns)])
    return table


def _facts(snapshot: Snapshot) -> list[tuple[str, str]]:
    """What the heartbeats tell, by service."""
    rows = []
    for name, robot in snapshot.robots.items():
        r = robot.message
        text = f"{r.state} in {r.world}, action {r.sequence}, bumps {r.bumps}, "
        text += f"laps {r.laps_left} left {r.laps_right} right"
        if r.pending_changes:
            text += f", changes of the world waiting {r.pending_changes}"
        if r.reason:
            text += f", stands still: {r.reason}"
        rows.append((f"robot {name}", text))
        if r.faults:
            faults = ", ".join(f"{fault.name} {fault.count}" for fault in r.faults)
            rows.append((f"faults of {name}", faults))
    for name, actor in snapshot.actors.items():
        a = actor.message
        text = f"{a.phase}, {a.actions_per_s:.1f} steps per second, weights {a.weights_version}"
        rows.append((f"actor of {name}", text))
    if snapshot.replay is not None:
        m = snapshot.replay.message
        text = f"episode {m.episode}, fitness {fitness(m)}, {replay_doing(m)}, "
        text += f"weights {m.weights_version}"
        rows.append(("replay", text))
        text = f"{m.size} of {m.capacity}: {by_action(m.by_action)}, "
        text += f"retention {retention(m)}"
        rows.append(("memory", text))
    if snapshot.learner is not None:
        n = snapshot.learner.message
        text = f"{learner_doing(n)}, episode {n.episode} done, weights {n.weights_version}, "
        text += f"{n.train_steps} training steps"
        rows.append(("learner", text))
    return rows


def _ping(bus: Bus, peer: Peer) -> ServiceReply | None:
    ident = f"{peer.service}-{peer.id}"
    try:
        return bus.request(PING, Ping(), ServiceReply, ident=ident, timeout_s=PING_S)
    except (BusError, BadMessage, ValueError):  # an id from outside may be too long for a key
        return None


def _complete(entries: Sequence[Entry], snapshot: Snapshot) -> bool:
    """Whether everybody who is there has told something."""
    told = {
        DRIVER.name: bool(snapshot.robots),
        ACTOR.name: bool(snapshot.actors),
        REPLAY.name: snapshot.replay is not None,
        LEARNER.name: snapshot.learner is not None,
    }
    return all(told.get(entry.peer.service, True) for entry in entries)
