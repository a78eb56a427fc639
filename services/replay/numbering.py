"""The numbers replay hands out: commits, global episodes, insertions, and each robot's progress.

Pure: the service keeps `Counters` on disk with the samples they number, the single-process loop
keeps them in a variable.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

from shared.config import MemoryConfig
from shared.errors import StateError
from shared.messages import Episode, RobotProgress


@dataclass(frozen=True)
class RobotCounters:
    """What is stored of one robot."""

    fills: int = 0
    episodes: int = 0
    life: str = ""
    """Driver life of the newest stored sample."""
    last_sequence: int = -1


@dataclass(frozen=True)
class Counters:
    """Everything replay counts, as of the newest commit."""

    commit: int = 0
    episode: int = 0
    next_id: int = 1
    filled: int = 0
    """Samples stored to fill the memory."""
    fill_surplus: int = 0
    """Samples of fill submissions beyond the capacity, not stored (A13)."""
    bumps: int = 0
    actions: int = 0
    """Actions of counted episodes."""
    laps_left: int = 0
    laps_right: int = 0
    dropped_samples: int = 0
    dropped_episodes: int = 0
    run_actions: int = 0
    """Actions since the last bump, across episodes (E10)."""
    longest_run_actions: int = 0
    robots: dict[str, RobotCounters] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """As plain values, for msgpack."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Counters:
        """From `to_dict()`. Raises StateError when it is damaged."""
        try:
            robots = {name: RobotCounters(**robot) for name, robot in values["robots"].items()}
            return cls(**{**values, "robots": robots})
        except (KeyError, TypeError, AttributeError) as error:
            raise StateError(f"replay counters on disk are damaged: {error}") from error


@dataclass(frozen=True)
class Commit:
    """One accepted submission: its numbers and what of it is stored."""

    commit: int
    episode: int
    """Global episode number; 0 for fill submissions."""
    first_id: int
    stored: int


def filling(counters: Counters, config: MemoryConfig) -> bool:
    """Whether the memory still awaits its first N samples (A13, E9)."""
    return config.fill != "none" and counters.filled < config.capacity


def refusal(counters: Counters, config: MemoryConfig, episode: Episode) -> str:
    """Why a submission can never be accepted as it is; empty if it can."""
    if not episode.fill and filling(counters, config):
        missing = config.capacity - counters.filled
        return f"the memory is being filled: {missing} samples missing, submit with fill = true"
    return ""


def accept(counters: Counters, config: MemoryConfig, episode: Episode) -> tuple[Commit, Counters]:
    """Number a submission: the commit, and the counters after it.

    While filling, what exceeds the capacity is not stored, so that D starts with exactly N samples
    (A13); fill submissions that come after the end store nothing.
    """
    robot = counters.robots.get(episode.robot, RobotCounters())
    if episode.fill:
        room = config.capacity - counters.filled if filling(counters, config) else 0
        stored, number = min(episode.count, room), 0
        robot = replace(robot, fills=robot.fills + 1)
        counters = replace(
            counters,
            filled=counters.filled + stored,
            fill_surplus=counters.fill_surplus + episode.count - stored,
        )
    else:
        stored, number = episode.count, counters.episode + 1
        robot = replace(robot, episodes=robot.episodes + 1)
        counters = _count_episode(counters, episode)
    robot = replace(robot, life=episode.robot_life, last_sequence=episode.last_sequence)
    commit = Commit(counters.commit + 1, number, counters.next_id, stored)
    return commit, replace(
        counters,
        commit=commit.commit,
        next_id=counters.next_id + stored,
        dropped_samples=counters.dropped_samples + episode.dropped_samples,
        dropped_episodes=counters.dropped_episodes + episode.dropped_episodes,
        robots={**counters.robots, episode.robot: robot},
    )


def progress_of(counters: Counters, config: MemoryConfig, robot: str) -> RobotProgress:
    """What an actor must know to go on with one robot."""
    known = counters.robots.get(robot, RobotCounters())
    still = filling(counters, config)
    return RobotProgress(
        robot=robot,
        filling=still,
        fill_missing=config.capacity - counters.filled if still else 0,
        robot_fills=known.fills,
        robot_episodes=known.episodes,
        episode=counters.episode,
        robot_life=known.life,
        last_sequence=known.last_sequence,
    )


def _count_episode(counters: Counters, episode: Episode) -> Counters:
    """Totals after a counted episode; a bump-free run excludes the bumping action (E10)."""
    run = counters.run_actions + episode.actions - int(episode.bump)
    return replace(
        counters,
        episode=counters.episode + 1,
        bumps=counters.bumps + int(episode.bump),
        actions=counters.actions + episode.actions,
        laps_left=counters.laps_left + episode.laps_left,
        laps_right=counters.laps_right + episode.laps_right,
        run_actions=0 if episode.bump else run,
        longest_run_actions=max(counters.longest_run_actions, run),
    )
