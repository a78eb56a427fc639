"""The numbers replay hands out: commits, global episodes, insertions, and each robot's progress."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from shared.config import MemoryConfig
from shared.errors import StateError
from shared.messages import MAX_EPISODE_SAMPLES, Episode, RobotProgress
from shared.rl.turn import Commit

MAX_ROBOTS = 256
"""Robots that one memory keeps numbers of."""
REACH = 2 * MAX_EPISODE_SAMPLES
"""The samples of a submission are of actions among this many up to its `last_sequence`."""
MAX_SPANS = 16
Span = tuple[int, int]
"""First and last of the sequences of a driver life that submissions settled."""


@dataclass(frozen=True)
class RobotCounters:
    """What replay counts of one robot."""

    fills: int = 0
    episodes: int = 0
    life: str = ""
    """Driver life of the newest stored sample."""
    last_sequence: int = -1
    run_actions: int = 0
    """Actions of counted episodes since the newest bump or interruption (E43)."""
    longest_run_actions: int = 0
    filled: bool = False
    """It was told that the memory is full."""


@dataclass(frozen=True)
class Counters:
    """Everything replay counts, as of the newest commit."""

    commit: int = 0
    episode: int = 0
    next_id: int = 1
    filled: int = 0
    """Samples that the memory held, or was given, when it was last filled."""
    fill_surplus: int = 0
    """Samples of fill submissions beyond the capacity, not stored (A13)."""
    bumps: int = 0
    actions: int = 0
    """Actions of counted episodes."""
    laps_left: int = 0
    laps_right: int = 0
    dropped_samples: int = 0
    dropped_episodes: int = 0
    robots: dict[str, RobotCounters] = field(default_factory=dict)

    @property
    def longest_run_actions(self) -> int:
        """Most actions that one robot drove without a bump, across episodes (E10, E43)."""
        return max((robot.longest_run_actions for robot in self.robots.values()), default=0)

    def plus(self, **amounts: int) -> "Counters":
        """Return the counters with these amounts added."""
        return replace(self, **{name: getattr(self, name) + n for name, n in amounts.items()})

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "Counters":
        """Return what `asdict` made of them. Raises StateError when it is damaged."""
        try:
            robots = {name: RobotCounters(**robot) for name, robot in values["robots"].items()}
            return cls(**{**values, "robots": robots})
        except (KeyError, TypeError, AttributeError) as error:
            raise StateError(f"replay counters on disk are damaged: {error}") from error


def filling(counters: Counters, config: MemoryConfig) -> bool:
    """Whether the memory still awaits its first N samples (A13, E9)."""
    return config.fill != "none" and counters.filled < config.capacity


def refill(counters: Counters, config: MemoryConfig, held: int) -> Counters:
    """The counters as settings change while the memory holds `held` samples, which count (E44)."""
    return replace(counters, filled=held) if filling(counters, config) else counters


def settled(spans: Sequence[Span], last: int) -> list[Span]:
    """The spans after a submission, the newest last. What is far from all begins a new one."""
    first = max(last - REACH + 1, 0)
    near = [span for span in spans if first <= span[1] + 1 and span[0] <= last]
    others = [span for span in spans if span not in near]
    return [*others, (min([first, *(a for a, _ in near)]), last)][-MAX_SPANS:]


def refusal(
    counters: Counters, config: MemoryConfig, episode: Episode, spans: Sequence[Span] = ()
) -> str:
    """Why a submission can never be accepted as it is, after its kind and a colon; empty if it can.

    spans: what is settled of this robot and `robot_life`. Each sample is of another executed
    action, so at least as many numbers were used up as there are samples.
    """
    known = counters.robots.get(episode.robot)
    if known is None and len(counters.robots) >= MAX_ROBOTS:
        return f"robots: expected at most {MAX_ROBOTS}"
    if not episode.fill and filling(counters, config):
        missing = config.capacity - counters.filled
        return (
            f"fill: the memory is being filled: {missing} samples missing, submit with fill = true"
        )
    if episode.fill and (config.fill == "none" or (known is not None and known.filled)):
        return "fill: the memory is not being filled, submit with fill = false"
    first = episode.last_sequence - episode.count + 1
    for begin, end in ((first, -1), *spans):
        if first <= end and begin <= episode.last_sequence:
            return (
                f"sequences: {episode.count} samples up to {episode.last_sequence} of robot life "
                f"{episode.robot_life}, of which all from {begin} to {end} are stored"
            )
    acted = int(np.frombuffer(episode.sample_versions, "<u4").max())
    if acted > episode.weights_version:
        return f"versions: weights {acted} acted, but {episode.weights_version} predicted"
    return ""


def lineage_after(lineage: str, identity: str, digest: str) -> str:
    """The lineage of a memory after one more submission: a hash over all of them, in order."""
    return hashlib.sha256(f"{lineage} {identity} {digest}".encode()).hexdigest()[:16]


def accept(counters: Counters, config: MemoryConfig, episode: Episode) -> tuple[Commit, Counters]:
    """Number a submission: the commit, and the counters after it.

    While filling, what exceeds the capacity is not stored: D starts with exactly N samples (A13).
    """
    robot = counters.robots.get(episode.robot, RobotCounters())
    if episode.fill:
        room = config.capacity - counters.filled if filling(counters, config) else 0
        stored, number = min(episode.count, room), 0
        robot = replace(robot, fills=robot.fills + 1)
        counters = counters.plus(filled=stored, fill_surplus=episode.count - stored)
    else:
        stored, number = episode.count, counters.episode + 1
        robot = replace(robot, episodes=robot.episodes + 1)
        counters = counters.plus(
            episode=1,
            bumps=int(episode.bump),
            actions=episode.actions,
            laps_left=episode.laps_left,
            laps_right=episode.laps_right,
        )
    run, length = bump_free(robot.run_actions, episode)
    robot = replace(
        robot,
        filled=not filling(counters, config),
        life=episode.robot_life,
        last_sequence=episode.last_sequence,
        run_actions=run,
        longest_run_actions=max(robot.longest_run_actions, length),
    )
    commit = Commit(counters.commit + 1, number, counters.next_id, stored)
    counters = counters.plus(
        commit=1,
        next_id=stored,
        dropped_samples=episode.dropped_samples,
        dropped_episodes=episode.dropped_episodes,
    )
    return commit, replace(counters, robots={**counters.robots, episode.robot: robot})


def bump_free(run: int, episode: Episode) -> tuple[int, int]:
    """The run that goes on after a submission, and how long it was with it, in actions (E10, E43).

    run: actions of the robot without a bump until then. A run excludes the bumping action and spans
    episodes; a bump or an interruption ends it. Actions that fill the memory do not count, nor do
    those of an episode that was dropped as a whole, at most the 50 of the look-ahead.
    """
    interrupted_before = episode.dropped_episodes > 0
    new = episode.fitness if interrupted_before else episode.actions
    counted = 0 if episode.fill else new - int(episode.bump)
    length = counted + (0 if interrupted_before else run)
    return length if episode.ended == "full" else 0, length


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
