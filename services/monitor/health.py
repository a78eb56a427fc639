"""Health check of one service, for containers: `python -m services.monitor.health replay`.

Healthy means: the service answers a ping, and its heartbeat, which its working thread sends, comes
as well. An actor without robots has no heartbeat, so for actors the ping alone counts. The router
is healthy when it accepts a session.
"""

from __future__ import annotations

import os
import sys
import time

from shared import settings
from shared.bus import Bus
from shared.config import Config
from shared.errors import BadMessage, BusError, ConfigError
from shared.keys import LEARNER_STATE, REPLAY_STATE, ROBOT_STATE, SERVICE, Stream
from shared.messages import (
    LearnerState,
    Message,
    ReplayState,
    RobotState,
    ServiceCommand,
    ServiceReply,
)

SERVICES = ("router", "driver", "actor", "replay", "learner")
HEARTBEATS: dict[str, tuple[Stream, type[Message]]] = {
    "driver": (ROBOT_STATE, RobotState),
    "replay": (REPLAY_STATE, ReplayState),
    "learner": (LEARNER_STATE, LearnerState),
}
PERIODS = 3
"""Heartbeat periods after which silence counts as sick."""


def problem(name: str, config: Config) -> str:
    """Why the service is not healthy, in one line; empty if it is."""
    if name not in SERVICES:
        return f"expected one of {', '.join(SERVICES)}, got {name!r}"
    try:
        with Bus(config.bus, config.run.name) as bus:
            return "" if name == "router" else _sickness(bus, name, config)
    except (BusError, BadMessage) as error:
        return str(error)


def _sickness(bus: Bus, name: str, config: Config) -> str:
    """Ping the service and wait for its heartbeat. Raises BusError when it does not answer."""
    ident = config.robot.id if name == "driver" else "main"
    inbox = bus.inbox()
    if name in HEARTBEATS:
        inbox.subscribe(HEARTBEATS[name][0], ident)
    bus.request(SERVICE, ServiceCommand(command="ping"), ServiceReply, ident=f"{name}-{ident}")
    if name not in HEARTBEATS:
        return ""
    deadline_s = time.monotonic() + PERIODS * config.bus.heartbeat_s
    while time.monotonic() < deadline_s:
        inbox.wait(0.1)
        if inbox.take(*HEARTBEATS[name]):
            return ""
    return f"{name} {ident}: answers, but sent no heartbeat for {PERIODS} periods"


def main(arguments: list[str]) -> int:
    """Check the named service as the environment says; 0 healthy, 1 not, with one line."""
    try:
        config = settings.load(env=os.environ)
    except ConfigError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    trouble = problem(arguments[0] if arguments else "", config)
    if trouble:
        sys.stderr.write(f"{trouble}\n")
    return 1 if trouble else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
