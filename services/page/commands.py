"""What a browser may ask for, checked, and carried out beside the thread that answers browsers."""

import threading
import time
from collections import deque
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from services.commander.takeover import Person
from services.page.watch import Watch
from shared.bus import Bus
from shared.errors import CorridorError
from shared.halts.book import ALL
from shared.halts.orders import RobotOrder, order
from shared.keys import ROBOT_WORLD
from shared.messages import ActionNumber, Ident, WorldChange, WorldChanged
from shared.service import new_life

MOST_BYTES = 4096
"""Size of one message of a browser."""
HALT_S = 120.0
"""A halt goes on until all stand, or so long."""
TOLD, LINES = 12, 12
"""Commands that are shown, and lines of each."""
HALTS: tuple[RobotOrder, ...] = ("estop", "pause")
AT_ONCE = {True: 32, False: 8}
"""Halts, and other commands, that may be under way."""


class Wish(BaseModel):
    """What a person who drives wants now (`Takeover`)."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    action: ActionNumber | None = None
    give_back: bool = False


class Command(BaseModel):
    """One message of a browser: it has painted an update, or wants something done."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    seen: int | None = None
    """Number of the update that it has painted."""
    token: Annotated[str, Field(max_length=100)] = ""
    robot: Ident | None = None
    """Which robot; None: all."""
    order: RobotOrder | None = None
    change: WorldChange | None = None
    note: Annotated[str, Field(min_length=1, max_length=200)] | None = None
    wish: Wish | None = None
    """For one robot."""

    @model_validator(mode="after")
    def _one_thing(self) -> Self:
        things = (self.seen, self.order, self.change, self.note, self.wish)
        if sum(each is not None for each in things) != 1 or (self.wish and not self.robot):
            raise ValueError("expected one of seen, order, change, note, and wish with a robot")
        return self

    @property
    def what(self) -> str:
        """The command in a few words."""
        if self.change:
            it = self.change
            return f"{it.kind} {it.world or it.name or (it.box and it.box.name) or ''}".strip()
        return {"estop": "emergency stop"}.get(self.order or "note", self.order or "note")


@dataclass
class Told:
    """What became of a command, for everybody who looks."""

    number: int
    at: str
    what: str
    robot: str
    lines: list[str] = field(default_factory=list)

    def __call__(self, line: str) -> None:
        """Add a line."""
        self.lines = [*self.lines, line][-LINES:]


class Desk:
    """Carries out commands. A stop waits for nothing."""

    def __init__(self, watch: Watch) -> None:
        self._watch = watch
        self._lock, self._number = threading.Lock(), 0
        self._under_way = {True: 0, False: 0}
        self._told: deque[Told] = deque(maxlen=TOLD)
        self._newest: dict[str, int] = {}
        """Number of the newest order to a robot, or to all: it ends the halts before it."""

    def told(self) -> list[dict[str, Any]]:
        """What became of the newest commands, newest last."""
        with self._lock:
            return [asdict(each) for each in self._told]

    def drive(self, robot: str, wish: Wish, people: dict[str, Person]) -> None:
        """Pass on what the person at one browser wants, who is another person for each robot."""
        if bus := self._watch.bus:
            person = people.get(robot)
            if person is None or person.bus is not bus:
                person = people[robot] = Person(bus, robot, person)
            person.say(wish.action, give_back=wish.give_back)

    def take(self, command: Command) -> threading.Thread:
        """Begin to carry out a command. Raises CorridorError when too many are under way."""
        with self._lock:
            self._number += 1
            told = Told(
                self._number, time.strftime("%H:%M:%S"), command.what, command.robot or "all robots"
            )
            halt = command.order in HALTS
            if self._under_way[halt] >= AT_ONCE[halt]:
                raise CorridorError(f"{command.what}: NOT sent: too much is under way")
            self._under_way[halt] += 1
            if command.order:
                self._newest[command.robot or ALL] = told.number
            self._told.append(told)
        thread = threading.Thread(target=self._do, args=(command, told), daemon=True)
        thread.start()
        return thread

    def _do(self, command: Command, told: Told) -> None:
        try:
            if command.note is not None:
                seen, folder = self._watch.snapshot.replay, self._watch.folder
                episode = seen.message.episode if seen else 0
                told(folder.note(command.note, episode) if folder else "NOT kept: no folder here")
            elif (bus := self._watch.bus) is None:
                told("NOT sent: no router answers")
            elif command.order:
                self._order(bus, command, told)
            elif command.change:
                self._change(bus, command.change, command.robot, told)
        except (CorridorError, OSError) as error:
            told(str(error))
        except Exception as error:
            told(f"failed: {error!r}")
            raise
        finally:
            with self._lock:
                self._under_way[command.order in HALTS] -= 1

    def _change(self, bus: Bus, change: WorldChange, robot: str | None, told: Told) -> None:
        wish = change.model_copy(update={"id": new_life()})
        for name in [robot] if robot else sorted({peer.id for peer in bus.peers("driver")}):
            answer = bus.request(ROBOT_WORLD, wish, WorldChanged, ident=name)
            waiting = f", {answer.pending} changes waiting" if answer.pending else ""
            refused, done = f"refused: {answer.reason}", f"world {answer.world}{waiting}"
            told(f"{name}: {done if answer.accepted else refused}")

    def _order(self, bus: Bus, command: Command, told: Told) -> None:
        robot, until_s = command.robot or ALL, time.monotonic() + HALT_S

        def newer() -> bool:
            return max(self._newest.get(robot, 0), self._newest.get(ALL, 0)) > told.number

        assert command.order is not None
        done = order(
            bus, command.order, robot, told, ended=lambda: newer() or time.monotonic() > until_s
        )
        text = "all stand" if command.order in HALTS else "done"
        told(text if done else "a newer order came" if newer() else "NOT all have obeyed")
