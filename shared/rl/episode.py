"""Episode bookkeeping (section 3.1, Fig 3.2): what is gathered, released, carried over, dropped."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from shared.config import EpisodeConfig

Ending = Literal["bump", "full", "interrupted"]


@dataclass(frozen=True, slots=True)
class Step:
    """One action and the state it was chosen in: the temporary tuple of A11."""

    image: bytes
    """uint8 [50, 75]."""
    action: int
    x_m: float
    y_m: float
    heading_rad: float
    world: str
    max_q: float
    """Clipped max_a Q of this state under `max_q_version`."""
    max_q_version: int
    acted_version: int
    """Weights version that chose the action."""
    number: int
    """Step within the robot's episode."""
    robot_episode: int
    sequence: int
    """The driver's number of the observation."""
    by: int = 0
    """Who chose the action: index into `facts.CHOOSERS`."""


@dataclass(frozen=True)
class Release:
    """What an ending hands over.

    steps: all steps that determine the rewards; the first `count` of them become samples. dropped:
    samples lost because their look-ahead crosses an interruption. fitness: A37, E10.
    """

    ending: Ending
    steps: tuple[Step, ...]
    count: int
    dropped: int
    fitness: int


class OpenEpisode:
    """The unprocessed steps of one robot."""

    def __init__(self, config: EpisodeConfig, steps: tuple[Step, ...] = ()) -> None:
        self._config = config
        self._steps = list(steps)

    def __len__(self) -> int:
        """Unprocessed steps, carried-over ones included."""
        return len(self._steps)

    @property
    def steps(self) -> tuple[Step, ...]:
        """The unprocessed steps, oldest first."""
        return tuple(self._steps)

    def add(self, step: Step) -> None:
        """Append the step just acted on. Raises ValueError beyond the maximum of A9."""
        if self.full:
            raise ValueError(f"an episode ends at {self._config.max_samples} samples")
        self._steps.append(step)

    def retract(self) -> None:
        """Take back the newest step: its action was never executed."""
        self._steps.pop()

    @property
    def full(self) -> bool:
        """Whether the episode ends here even without a bump (A9: 500 samples)."""
        return len(self._steps) >= self._config.max_samples

    def end(self, ending: Ending) -> Release:
        """End the episode and keep only what is carried over (A10).

        bump: all samples are released; the last one is terminal (E6). full: all but the last 50 are
        released, those open the next episode. interrupted: the last 50 are dropped (E10).
        """
        n, horizon = len(self._steps), self._config.horizon
        if ending == "bump" and n == 0:
            raise ValueError("a bump ends at least one action (E11)")
        if ending == "full" and not self.full:
            raise ValueError(f"not full: {n} of {self._config.max_samples} samples")
        count = n if ending == "bump" else max(n - horizon, 0)
        dropped = n - count if ending == "interrupted" else 0
        release = Release(ending, tuple(self._steps), count, dropped, fitness=n)
        self._steps = self._steps[count:] if ending == "full" else []
        return release


def with_current_max_q(
    steps: tuple[Step, ...],
    values: npt.NDArray[np.float32],
    stale: npt.NDArray[np.int64],
    version: int,
) -> tuple[Step, ...]:
    """Steps whose stale predictions are replaced by `values` [k, 3] of the current version."""
    fresh = list(steps)
    for row, index in enumerate(stale):
        fresh[index] = replace(fresh[index], max_q=float(values[row].max()), max_q_version=version)
    return tuple(fresh)


def stale_steps(release: Release, version: int) -> npt.NDArray[np.int64]:
    """Indices of next states of released samples whose prediction is of another version (A17)."""
    last = min(release.count, len(release.steps) - 1)
    return np.array(
        [i for i in range(1, last + 1) if release.steps[i].max_q_version != version], np.int64
    )
