"""Halts robots and releases them, and tells who stands: for the command line and other tools.

A halt is sent again until every driver that is there, or was there meanwhile, has shown that its
robot stands. Services keep it for drivers that restart (`shared.halts.keeper`).
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Literal

from shared.bus import Bus
from shared.errors import PeerMissing, meant
from shared.halts.book import ALL, RELEASE_WITHIN_S, new_halt
from shared.keys import HALT, RELEASE, Role
from shared.messages import MAX_HALTS, Deadline, HaltKind, Halts, Message, Release, Standing

REPEAT_S = 0.3
"""A halt that is not confirmed is sent again after this time."""
NOBODY_S = 3.0
"""Without any robot, the search for one ends after this time."""
DRIVER: Role = "driver"
Echo = Callable[[str], None]
RobotOrder = Literal["estop", "clear", "pause", "resume"]


def order(
    bus: Bus,
    name: RobotOrder,
    robot: str,
    echo: Echo,
    *,
    number: int | None = None,
    ended: Callable[[], bool] = lambda: False,
) -> bool:
    """Carry out an operator's order; return whether every robot that is meant obeys.

    Raises PeerMissing if there is none.
    """
    kind: HaltKind = "estop" if name in ("estop", "clear") else "pause"
    if name in ("estop", "pause"):
        return halt(bus, kind, robot, echo, number=number, ended=ended)
    return release(bus, kind, robot, echo)


@dataclass
class Roll:
    """The drivers' lives that are meant, and what each answered last."""

    robot: str
    missing: dict[str, str] = field(default_factory=dict)
    """Life to robot: there, or once there, and without a satisfying answer."""
    done: dict[str, Standing] = field(default_factory=dict)

    def call(self, bus: Bus) -> None:
        """Note who is there now."""
        for peer in bus.peers(DRIVER, self.robot or "*"):
            if peer.life not in self.done:
                self.missing[peer.life] = peer.id

    def note(self, answer: Standing) -> bool:
        """Strike off a driver that answered as it should; whether it is new."""
        self.missing.pop(answer.life, None)
        new = answer.life not in self.done
        self.done[answer.life] = answer
        return new

    def concerns(self, answer: Standing) -> bool:
        """Whether an answer is that of a driver that is meant."""
        return answer.service == DRIVER and self.robot in (ALL, answer.id)


def halt(
    bus: Bus,
    kind: HaltKind,
    robot: str,
    echo: Echo,
    *,
    number: int | None = None,
    ended: Callable[[], bool] = lambda: False,
) -> bool:
    """Halt one robot, or all if it is empty; return whether all stand.

    It goes on until all that are or were there stand, or `ended` is true, or nobody is there.
    number: that of a halt that was sent before.
    """
    message = new_halt(kind, robot, time.time_ns() if number is None else number)
    roll, start_s = Roll(robot), time.monotonic()
    while not ended():
        for answer in _round(bus, message, REPEAT_S, roll):
            if answer.problem:
                echo(f"{_name(answer)}: stands, but a restart would forget it: {answer.problem}")
            elif answer.stands and roll.note(answer):
                echo(f"{_name(answer)}: {answer.state}, stands")
        if roll.done and not roll.missing:
            return True
        if not roll.done and not roll.missing and time.monotonic() - start_s > NOBODY_S:
            raise PeerMissing(
                f"no robot of run {bus.run!r} answers at {bus.config.endpoint}; services that "
                f"are there hold it for a robot that starts{_meant(bus, robot)}"
            )
    for life, name in roll.missing.items():
        echo(f"{name} (life {life}): has not answered")
    return False


def release(bus: Bus, kind: HaltKind, robot: str, echo: Echo, attempts: int = 3) -> bool:
    """End the halts of one kind that are in force; return whether no robot meant is held by one.

    Each release names the halts and lives that answered just before, and expires there.
    """
    roll = Roll(robot)
    for _ in range(attempts):
        answers = list(_round(bus, Halts(), REPEAT_S, roll))
        deadlines = [
            Deadline(life=answer.life, until_s=answer.clock_s + RELEASE_WITHIN_S)
            for answer in answers
        ]
        numbers = {h.number for answer in answers for h in answer.halts if h.kind == kind}
        if numbers:
            message = Release(
                numbers=tuple(sorted(numbers)[:MAX_HALTS]), robot=robot, deadlines=tuple(deadlines)
            )
            answers = list(_round(bus, message, REPEAT_S, roll))
        for answer in answers:
            held = any(halt.kind == kind for halt in answer.halts)
            if roll.concerns(answer) and not held and not answer.problem and roll.note(answer):
                echo(f"{_name(answer)}: {answer.state}")
            elif roll.concerns(answer) and answer.problem:
                echo(f"{_name(answer)}: not released: {answer.problem}")
        if roll.done and not roll.missing:
            return True
    if not roll.done and not roll.missing:
        text = f"no robot of run {bus.run!r} answers at {bus.config.endpoint}"
        raise PeerMissing(text + _meant(bus, robot))
    for life, name in roll.missing.items():
        echo(f"{name} (life {life}): has not answered, or stays halted")
    return False


def _round(bus: Bus, message: Message, wait_s: float, roll: Roll) -> Iterator[Standing]:
    """Ask everybody once; answers as they come, until every driver meant has answered, or a while.

    Services are waited for as well where it matters who knows of a halt (not for a new one).
    """
    inbox, until_s = bus.inbox(), time.monotonic() + wait_s
    stream = RELEASE if isinstance(message, Release) else HALT
    inbox.ask_all(stream, message, timeout_s=wait_s)
    roll.call(bus)
    urgent = isinstance(message, Halts) and bool(message.halts)
    waited = set(roll.missing) if urgent else {peer.life for peer in bus.peers()}
    while (left_s := until_s - time.monotonic()) > 0:
        inbox.wait(left_s)
        for answer in inbox.answers(Standing):
            waited.discard(answer.life)
            if roll.concerns(answer) or not urgent:
                yield answer
        if not waited:
            return


def _meant(bus: Bus, robot: str) -> str:
    return meant(robot, {peer.id for peer in bus.peers(DRIVER)})


def _name(answer: Standing) -> str:
    return f"{answer.id} (life {answer.life})"
