"""What a run tells of itself while it goes on."""

from __future__ import annotations

from dataclasses import dataclass

from experiments.plans.plan import Unit
from experiments.single_process import SingleProcess, TurnDone


@dataclass(frozen=True)
class Progress:
    """How far a run is."""

    run: str
    done: int
    of: int
    unit: Unit
    fitness: float
    """Mean over the last episodes."""


class Watch:
    """Sees every turn of a run. This one does nothing about it."""

    def begin(self, loop: SingleProcess) -> None:
        """The run begins, or goes on from its last snapshot."""

    def turn(self, loop: SingleProcess, done: TurnDone) -> None:
        """A turn is over. The run may be stopped, and done again from an older snapshot."""
