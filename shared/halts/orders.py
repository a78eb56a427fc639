"""Halts robots and releases them, and tells who stands.

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
ATTEMPTS = 3
"""So often a release is tried."""
DRIVER: Role = "driver"
Echo = Callable[[str], None]
RobotOrder = Literal["estop", "clear", "pause", "resume"]


@dataclass
class Roll:
    """The drivers' lives that are meant, and what each answered last."""

    robot: str
    missing: dict[str, str] = field(default_factory=dict)
    """Life to robot: there, or once there, and without a satisfying answer."""
    done: dict[str, Standing] = field(default_factory=dict)

    @property
    def empty(self) -> bool:
        """Whether no driver that is meant was ever there."""
        return not self.done and not self.missing

    @property
    def complete(self) -> bool:
        """Whether all that are or were there answered as they should."""
        return bool(self.done) and not self.missing

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


def order(
    bus: Bus,
    name: RobotOrder,
    robot: str,
    echo: Echo,
    *,
    number: int | None = None,
    ended: Callable[[], bool] = lambda: False,
) -> bool:
    """Carry out an operator's order for one robot, or all if it is empty; return whether all obey.

    A halt goes on until all that are or were there stand, or `ended` is true. number: that of a
    halt that was sent before. Raises PeerMissing if there is no robot.
    """
    kind: HaltKind = "estop" if name in ("estop", "clear") else "pause"
    roll = Roll(robot)
    if name in ("estop", "pause"):
        message = new_halt(kind, robot, time.time_ns() if number is None else number)
        _halt(bus, message, echo, roll, ended)
    else:
        _release(bus, kind, echo, roll)
    for life, ident in roll.missing.items():
        echo(f"{ident} (life {life}): has not answered, or does not obey")
    return roll.complete


def _halt(bus: Bus, message: Halts, echo: Echo, roll: Roll, ended: Callable[[], bool]) -> None:
    start_s = time.monotonic()
    while not roll.complete and not ended():
        for answer in _round(bus, message, REPEAT_S, roll):
            if answer.problem:
                echo(f"{_name(answer)}: stands, but a restart would forget it: {answer.problem}")
            elif answer.stands and roll.note(answer):
                echo(f"{_name(answer)}: {answer.state}, stands")
        if roll.empty and time.monotonic() - start_s > NOBODY_S:
            raise PeerMissing(
                f"no robot of run {bus.run!r} answers at {bus.config.endpoint}; services that "
                f"are there hold it for a robot that starts{_meant(bus, roll.robot)}"
            )


def _release(bus: Bus, kind: HaltKind, echo: Echo, roll: Roll) -> None:
    """Each release names the halts and lives that answered just before, and expires there."""
    for _ in range(ATTEMPTS):
        answers = list(_round(bus, Halts(), REPEAT_S, roll))
        deadlines = tuple(
            Deadline(life=answer.life, until_s=answer.clock_s + RELEASE_WITHIN_S)
            for answer in answers
        )
        numbers = {h.number for answer in answers for h in answer.halts if h.kind == kind}
        if numbers:
            some = tuple(sorted(numbers)[:MAX_HALTS])
            message = Release(numbers=some, robot=roll.robot, deadlines=deadlines)
            answers = list(_round(bus, message, REPEAT_S, roll))
        for answer in filter(roll.concerns, answers):
            held = any(halt.kind == kind for halt in answer.halts)
            if answer.problem:
                echo(f"{_name(answer)}: not released: {answer.problem}")
            elif not held and roll.note(answer):
                echo(f"{_name(answer)}: {answer.state}")
        if roll.complete:
            return
    if roll.empty:
        text = f"no robot of run {bus.run!r} answers at {bus.config.endpoint}"
        raise PeerMissing(text + _meant(bus, roll.robot))


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
