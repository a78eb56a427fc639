"""Which halts are in force: a book that every driver and every service keeps (no bus, no disk).

A halt is in force until a release names its number. What was released stays released, so books can
be joined in any order, and as often as one likes, with the same result.
"""

from collections.abc import Iterable
from typing import Any

from shared.messages import MAX_HALTS, MAX_RELEASED, Halt, HaltKind, Halts, Release, Released

ALL = ""
"""In place of a robot's name: every robot of the run."""
RELEASE_WITHIN_S = 2.0
"""A release must be carried out within this time of what its sender last heard of a life."""


class HaltBook:
    """Halts in force and halts released; of one robot, or of the whole run."""

    def __init__(self, robot: str = ALL) -> None:
        """robot: keep only what concerns it; empty: keep everything."""
        self.robot = robot
        self._halts: dict[int, Halt] = {}
        self._released: set[tuple[int, str]] = set()
        self.overflowed = 0
        """Halts not taken over because too many were in force; they could hold no robot more."""

    def add(self, halts: Iterable[Halt]) -> bool:
        """Take over halts that are not known; whether there was one."""
        before = set(self._halts)
        for halt in halts:
            known = halt.number in self._halts or self._over(halt)
            if known or (self.robot and halt.robot not in (ALL, self.robot)):
                continue
            if len(self._halts) >= MAX_HALTS:
                self.overflowed += 1
                continue
            self._halts[halt.number] = halt
        return set(self._halts) != before

    def release(self, numbers: Iterable[int], robot: str = ALL) -> bool:
        """End halts, for one robot or for all; whether something is different now."""
        before = (set(self._halts), set(self._released))
        if not self.robot or robot in (ALL, self.robot):
            self._released |= {(number, robot) for number in numbers}
        self._halts = {n: halt for n, halt in self._halts.items() if not self._over(halt)}
        in_force = {entry for entry in self._released if entry[0] in self._halts}
        others = sorted(self._released - in_force)[-MAX_RELEASED:]
        self._released = in_force | set(others)
        return (set(self._halts), self._released) != before

    def holding(self, robot: str) -> tuple[Halt, ...]:
        """The halts that hold one robot now, oldest first."""
        return tuple(
            halt
            for halt in self.halts
            if halt.robot in (ALL, robot) and (halt.number, robot) not in self._released
        )

    def kinds(self, robot: str) -> set[HaltKind]:
        """The kinds of halts that hold one robot now."""
        return {halt.kind for halt in self.holding(robot)}

    @property
    def halts(self) -> tuple[Halt, ...]:
        """All halts in force, oldest first."""
        return tuple(halt for _, halt in sorted(self._halts.items()))

    @property
    def released(self) -> tuple[Released, ...]:
        """What was released, the newest `MAX_RELEASED`."""
        newest = sorted(self._released)[-MAX_RELEASED:]
        return tuple(Released(number=number, robot=robot) for number, robot in newest)

    def join(self, halts: Iterable[Halt], released: Iterable[Released]) -> bool:
        """Take over what another book has; whether something is different now."""
        changed = False
        for entry in released:
            changed |= self.release([entry.number], entry.robot)
        return self.add(halts) or changed

    def saved(self) -> dict[str, Any]:
        """The whole book, for msgpack."""
        return {
            "halts": [halt.model_dump() for halt in self.halts],
            "released": [entry.model_dump() for entry in self.released],
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Join what `saved()` gave. Raises KeyError, TypeError or ValueError when it is damaged."""
        self.join(
            [Halt.model_validate(halt) for halt in saved["halts"]],
            [Released.model_validate(entry) for entry in saved["released"]],
        )

    def _over(self, halt: Halt) -> bool:
        """Whether this halt ended for everybody this book is about."""
        entries = {(halt.number, ALL)}
        for robot in (self.robot, halt.robot):
            entries |= {(halt.number, robot)} if robot else set()
        return not entries.isdisjoint(self._released)


def means(release: Release, life: str, clock_s: float) -> bool:
    """Whether a release means this life and comes in time."""
    return any(
        deadline.life == life and clock_s <= deadline.until_s <= clock_s + RELEASE_WITHIN_S
        for deadline in release.deadlines
    )


def new_halt(kind: HaltKind, robot: str, now_ns: int) -> Halts:
    """A halt with a number of its own: the sender's clock."""
    return Halts(halts=(Halt(number=now_ns, kind=kind, robot=robot),))
