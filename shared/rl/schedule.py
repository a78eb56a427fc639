"""When something periodic is due: after so many episodes, or after so many actions (E25, E39)."""

from typing import NamedTuple


class Moment(NamedTuple):
    """How far a run is at the end of an episode."""

    episode: int
    """Global episode number; 0 while the memory is filled."""
    total_actions: int = 0
    """Actions of counted episodes until then, those of this episode included."""
    actions: int = 0
    """Actions of this episode."""


def due(now: Moment, every_episodes: int, every_actions: int = 0) -> bool:
    """Whether a periodic step falls on this moment, by actions if both are given; 0: never."""
    if not now.episode:
        return False
    if every_actions:
        before = now.total_actions - now.actions
        return now.total_actions // every_actions > before // every_actions
    return every_episodes > 0 and now.episode % every_episodes == 0
