"""What services do about halts: hear of them, keep them on disk, tell them to whoever missed them.

A driver that restarts, or comes back from behind a broken network, learns so of a halt in force.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from shared import statefile
from shared.errors import StateError
from shared.halts.book import HaltBook, means
from shared.keys import HALT, RELEASE
from shared.messages import DriverState, Halts, Release, Standing

if TYPE_CHECKING:
    from shared.bus import Request
    from shared.service import Service

FOLDER = "halts"
"""Folder of a run in which every process of the run that hears of halts keeps its book."""
REPEAT_S = 1.0
TICK_S = 0.2
log = logging.getLogger(__name__)


def clock_s() -> float:
    """The clock by which releases expire: it goes on while process or machine sleep."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class KeptBook:
    """A book of halts on disk. One thread owns it."""

    def __init__(self, folder: Path, service: str, ident: str, life: str, robot: str = "") -> None:
        """Read all books of the run folder; keep only what concerns `robot`. Raises StateError."""
        self.book = HaltBook(robot)
        self._who = (service, ident, life)
        self._path = folder / FOLDER / f"{service}-{ident}.msgpack"
        self.problem = ""
        for path in sorted(self._path.parent.glob("*.msgpack")):
            try:
                if (saved := statefile.read(path)) is not None:
                    self.book.restore(saved)
            except (KeyError, TypeError, ValueError) as error:
                raise StateError(f"{path}: damaged halts: {error}") from error

    def hear(self, message: Halts | Release) -> bool:
        """Take up what came, on disk before it is answered; whether something is different now.

        A halt that cannot be kept holds all the same; a release that cannot be kept is none.
        """
        if isinstance(message, Halts):
            changed = self.book.add(message.halts)
        elif means(message, self._who[2], clock_s()):
            changed = self._release(message)
        else:
            changed = False
        if changed or self.problem:
            self._keep()
        return changed

    def join(self, answers: Iterable[Standing]) -> bool:
        """Take over the halts that others know of, but no release; whether there was a new one."""
        changed = False
        for answer in answers:
            changed |= self.book.add(answer.halts)
        if changed:
            self._keep()
        return changed

    def standing(self, state: DriverState | Literal[""] = "", *, stands: bool = False) -> Standing:
        """The answer to every message about halts."""
        service, ident, life = self._who
        return Standing(
            service=service,
            id=ident,
            life=life,
            clock_s=clock_s(),
            state=state,
            stands=stands,
            halts=self.book.halts,
            released=self.book.released,
            problem=self.problem,
        )

    def _release(self, message: Release) -> bool:
        before = self.book.saved()
        if not self.book.release(message.numbers, message.robot):
            return False
        self._keep()
        if self.problem:
            self.book = HaltBook(self.book.robot)
            self.book.restore(before)
            return False
        return True

    def _keep(self) -> None:
        try:
            statefile.save(self._path, self.book.saved())
            self.problem = ""
        except OSError as error:
            self.problem = f"{self._path}: {error}"[:300]
            log.error("halts: %s; a restart would forget them", self.problem)


class HaltKeeper(threading.Thread):
    """The thread of a service without a robot: answers, and repeats while a halt is in force."""

    def __init__(self, me: Service, folder: Path) -> None:
        super().__init__(name="halts", daemon=True)
        self._me = me
        self._kept = KeptBook(folder, me.name, me.ident, me.life)
        self._inbox = me.bus.inbox()
        self._inbox.serve(HALT)
        self._inbox.serve(RELEASE)
        me.stop.on_set(self._inbox.wake)
        self.start()

    def run(self) -> None:
        """Serve until the service stops."""
        next_s = 0.0
        while not self._me.stop.is_set():
            self._inbox.wait(TICK_S)
            for request in self._inbox.requests():
                with request:
                    self._answer(request)
            self._kept.join(self._inbox.answers(Standing))
            now_s = time.monotonic()
            if self._kept.book.halts and now_s >= next_s:
                next_s = now_s + REPEAT_S
                halts = Halts(halts=self._kept.book.halts)
                self._inbox.ask_all(HALT, halts, timeout_s=REPEAT_S)

    def _answer(self, request: Request) -> None:
        if isinstance(request.message, Halts | Release):
            if self._kept.hear(request.message):
                self._me.log.info("halts: %s", request.message)
            request.reply(self._kept.standing())
