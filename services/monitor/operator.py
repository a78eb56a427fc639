"""What a person tells a run from outside: stop, emergency stop, pause, another world, and back."""

import time
from collections.abc import Sequence
from typing import Any, TypeVar

import typer
from pydantic import ValidationError

from services.processes import BY_NAME, DRIVER, SERVICES
from shared.bus import Bus
from shared.config import Config
from shared.errors import BadMessage, BusError, ConfigError, PeerMissing, first_problem, meant
from shared.facts import NAME
from shared.halts.book import ALL
from shared.halts.orders import RobotOrder, order
from shared.keys import ROBOT_WORLD, STOP, Peer, Stream
from shared.messages import Message, ServiceReply, StopService, WorldChange, WorldChanged
from shared.service import new_life
from shared.threads import stop_on_signals

M = TypeVar("M", bound=Message)

STOP_ORDER = [process.name for process in reversed(SERVICES)]
"""The robot first."""
ATTEMPTS, ATTEMPT_S = 3, 1.0
GONE_WITHIN_S = 10.0


def command_robots(
    config: Config, name: RobotOrder, robot: str | None, number: int | None = None
) -> int:
    """Halt one robot or all of the run, or release them; print what each answers.

    A halt goes on until all stand, or until Ctrl-C. number: that of a halt that was sent before.
    Returns 1 if a robot did not answer, else 0.

    Raises ConfigError (`robot` is not a name), PeerMissing or RouterMissing.
    """
    _check_name(robot)
    with Bus(config.bus, config.run.name) as bus, stop_on_signals() as ended:
        obeyed = order(bus, name, robot or ALL, typer.echo, number=number, ended=ended.is_set)
    return 0 if obeyed else 1


def _check_name(robot: str | None) -> None:
    if robot is not None and not NAME.match(robot):
        raise ConfigError(f"--robot: expected a name like {NAME.pattern}, got {robot!r}")


def change_world(config: Config, robot: str | None, **change: Any) -> int:
    """Wish for a change (fields of `WorldChange`) of one robot's world or all; print the answers.

    Returns 1 if a robot did not answer or refused, else 0.

    Raises ConfigError (it cannot be meant), PeerMissing or RouterMissing.
    """
    try:
        message = WorldChange.model_validate({"id": new_life(), **change})
    except ValidationError as error:
        raise ConfigError(f"{change['kind']}: {first_problem(error)}") from error

    _check_name(robot)
    with Bus(config.bus, config.run.name) as bus:
        present = sorted({peer.id for peer in bus.peers(DRIVER.name)})
        names = [robot] if robot is not None else present
        if not names:
            raise PeerMissing(
                f"no robot of run {config.run.name!r} answers at {config.bus.endpoint}"
            )
        done = [_change_world(bus, name, message, present) for name in names]
        return 0 if all(done) else 1


def _change_world(bus: Bus, name: str, message: WorldChange, present: Sequence[str]) -> bool:
    """Tell one robot of a wish and print its answer; whether it accepted."""
    try:
        answer = _ask(bus, ROBOT_WORLD, message, WorldChanged, name)
    except (BusError, BadMessage) as error:
        text = f"{name}: no answer to {message.kind}: {error}{meant(name, present)}"
        typer.echo(text, err=True)
        return False
    if not answer.accepted:
        typer.echo(f"{name}: refused: {answer.reason}", err=True)
        return False
    boxes = f"obstacles {', '.join(answer.obstacles)}" if answer.obstacles else "no obstacles"
    typer.echo(f"{name}: world {answer.world}, {boxes}, {answer.pending} changes waiting")
    return True


def stop_services(config: Config, services: Sequence[str]) -> int:
    """Ask services to stop (none named: all), drivers first, and wait until they are gone.

    Returns 1 if one is still there at the end, else 0. Raises PeerMissing or RouterMissing.
    """
    with Bus(config.bus, config.run.name) as bus:
        there = bus.peers()
        peers = [p for p in there if not services or p.service in services]
        if not peers:
            wanted = " or ".join(services) or "service"
            text = f"no {wanted} of run {config.run.name!r} at {config.bus.endpoint}"
            known = {peer.service for peer in there} | BY_NAME.keys()
            raise PeerMissing(text + "".join(meant(name, known) for name in services))
        for peer in sorted(peers, key=_stop_place):
            try:
                _ask(bus, STOP, StopService(), ServiceReply, f"{peer.service}-{peer.id}")
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
