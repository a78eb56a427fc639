"""What a person tells a run from outside: stop, emergency stop, pause, and back."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Literal, TypeVar

import typer

from shared.bus import Bus
from shared.config import Config
from shared.errors import BadMessage, BusError, ConfigError, PeerMissing
from shared.keys import IDENT, ROBOT_COMMAND, SERVICE, Peer, Stream
from shared.messages import Message, RobotCommand, RobotState, ServiceCommand, ServiceReply

Command = Literal["estop", "clear", "pause", "resume"]
M = TypeVar("M", bound=Message)

DRIVER = "driver"
STOP_ORDER = (DRIVER, "actor", "learner", "replay")
ATTEMPTS, ATTEMPT_S = 3, 1.0
GONE_WITHIN_S = 10.0


def command_robots(config: Config, command: Command, robot: str | None) -> int:
    """Send a command to one robot or all of the run; print the state each acknowledges.

    Returns:
        0, or 1 if a robot did not answer.

    Raises:
        ConfigError: `robot` is not a name.
        PeerMissing: there is no robot.
        RouterMissing: there is no router.
    """
    if robot is not None and not IDENT.match(robot):
        raise ConfigError(f"--robot: expected a name like {IDENT.pattern}, got {robot!r}")
    message = RobotCommand(command=command)
    with Bus(config.bus, config.run.name) as bus:
        present = [peer.id for peer in bus.peers() if peer.service == DRIVER]
        names = [robot] if robot is not None else present
        if not names:
            raise PeerMissing(
                f"no robot of run {config.run.name!r} answers at {config.bus.endpoint}"
            )
        failed = 0
        for name in names:
            try:
                state = _ask(bus, ROBOT_COMMAND, message, RobotState, name)
            except (BusError, BadMessage) as error:
                failed += 1
                typer.echo(f"{name}: no answer to {command!r}: {error}", err=True)
                continue
            typer.echo(f"{name}: {state.state}")
    return 1 if failed else 0


def stop_services(config: Config, services: Sequence[str]) -> int:
    """Ask services to stop, drivers first, and wait until they are gone.

    Args:
        config: how to reach the run.
        services: names of services; empty: all.

    Returns:
        0, or 1 if one is still there at the end.

    Raises:
        PeerMissing: nobody to stop.
        RouterMissing: there is no router.
    """
    message = ServiceCommand(command="stop")
    with Bus(config.bus, config.run.name) as bus:
        peers = [p for p in bus.peers() if not services or p.service in services]
        if not peers:
            wanted = " or ".join(services) or "service"
            raise PeerMissing(f"no {wanted} of run {config.run.name!r} at {config.bus.endpoint}")
        for peer in sorted(peers, key=_stop_place):
            try:
                _ask(bus, SERVICE, message, ServiceReply, f"{peer.service}-{peer.id}")
            except (BusError, BadMessage) as error:
                typer.echo(f"{peer.service} {peer.id}: no answer: {error}", err=True)
        left = _wait_gone(bus, peers)
    for peer in peers:
        typer.echo(f"{peer.service} {peer.id}: {'still there' if peer in left else 'stopped'}")
    return 1 if left else 0


def _ask(bus: Bus, stream: Stream, message: Message, cls: type[M], ident: str) -> M:
    """Ask a few times; the last failure counts."""
    for _ in range(ATTEMPTS - 1):
        try:
            return bus.request(stream, message, cls, ident=ident, timeout_s=ATTEMPT_S)
        except BusError:
            time.sleep(0.1)
    return bus.request(stream, message, cls, ident=ident, timeout_s=ATTEMPT_S)


def _wait_gone(bus: Bus, peers: Sequence[Peer]) -> list[Peer]:
    """Those of the peers that are still alive after some time."""
    deadline_s = time.monotonic() + GONE_WITHIN_S
    left = list(peers)
    while left and time.monotonic() < deadline_s:
        time.sleep(0.1)
        alive = bus.peers()
        left = [peer for peer in left if peer in alive]
    return left


def _stop_place(peer: Peer) -> int:
    return STOP_ORDER.index(peer.service) if peer.service in STOP_ORDER else len(STOP_ORDER)
