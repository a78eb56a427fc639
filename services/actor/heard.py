"""Whom a session of the actor believes: one life of its robot, and the newest learner."""

from collections.abc import Callable, Collection
from dataclasses import dataclass

from shared.messages import LearnerState, Observation

RIVAL_SILENT_S = 2.0
"""After this time another life of a robot is served if the one before is not heard any more."""


@dataclass
class Newest:
    """The newest announcement of the learner."""

    state: LearnerState | None = None

    def note(self, state: LearnerState, lives: Collection[str]) -> bool:
        """Take over a state, unless others have the learner's role; whether it is believed."""
        believed = not lives or state.life in lives
        if believed:
            self.state = state
        return believed


class ServedLife:
    """The life of a robot that is served: one at a time, and none is silenced for good."""

    def __init__(self, lives: Callable[[], Collection[str]]) -> None:
        """lives: which of the driver's lives have its role now."""
        self._lives = lives
        self.life = ""
        self.heard_s = 0.0
        """When it was last heard of."""

    def takes(self, observation: Observation, now_s: float) -> bool:
        """Whether an observation is of the life that is served now.

        Another life takes over if only it has the driver's role, if the one before has been silent
        for `RIVAL_SILENT_S`, or if it continues that one, which has not the role alone.
        """
        life = observation.life
        if life != self.life:
            new, old = (each in self._lives() for each in (life, self.life))
            continues = self.life in observation.earlier and (new or not old)
            if self.life and not (continues or (new and not old) or self.silent(now_s)):
                return False
            self.life = life
        self.heard_s = now_s
        return True

    def silent(self, now_s: float) -> bool:
        """Whether nothing was heard of it for a while."""
        return now_s - self.heard_s > RIVAL_SILENT_S
