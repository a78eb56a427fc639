"""Where the learner stands in the history of the memory, and which turns follow from there."""

from collections.abc import Sequence
from dataclasses import dataclass

from shared.errors import StateError
from shared.messages import NO_LINEAGE, Turn

REMEDY = "restore memory and checkpoint of one moment, or move the checkpoint away"


@dataclass(frozen=True)
class Place:
    """The newest turn done, and the lineage that the memory had there."""

    episode: int = 0
    lineage: str = NO_LINEAGE

    @property
    def since(self) -> int:
        """After which episode to ask for turns, so that the answer begins with the newest done."""
        return max(self.episode - 1, 0)

    def next_turns(self, turns: Sequence[Turn], checkpoint: object) -> tuple[Turn, ...]:
        """The turns to do, of what comes after `since`. Raises StateError: of another memory."""
        if self.episode:
            if not turns or turns[0].episode != self.episode:
                raise StateError(
                    f"replay has no turn {self.episode}, but the checkpoint {checkpoint} is of "
                    f"that episode: they do not belong together: {REMEDY}"
                )
            if turns[0].lineage != self.lineage:
                raise StateError(
                    f"replay's turn {self.episode} has lineage {turns[0].lineage}, but that of the "
                    f"checkpoint {checkpoint} is {self.lineage or 'not known'}: the memory has "
                    f"another history: {REMEDY}"
                )
            turns = turns[1:]
        expected = range(self.episode + 1, self.episode + 1 + len(turns))
        in_order = (turn.episode == number for turn, number in zip(turns, expected, strict=True))
        return tuple(turns) if all(in_order) else ()
