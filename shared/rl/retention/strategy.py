"""The interface of a strategy of retention, and the discard that every strategy takes part in.

What stays is 99 % of the capacity, or of each action's share of it (A27, A33, E22).
"""

# ruff: noqa: ARG002  (defaults of an interface)

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from shared import plugins
from shared.facts import ACTION_COUNT
from shared.rl.draws import uniform
from shared.rl.retention.table import STRATEGIES, TELLS

if TYPE_CHECKING:
    from shared.config import MemoryConfig
    from shared.rl.engine import Progress
    from shared.rl.memory import Ids, ReplayMemory
    from shared.rl.predictor import Predictor

Rows = npt.NDArray[np.void]
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Situation:
    """What is there when a memory may have to discard."""

    memory: ReplayMemory
    number: int
    """Global episode number, 0 while the memory is filled."""
    config: MemoryConfig
    network: Predictor
    """The target network."""
    seed: int
    """Seed of the run, for strategies that draw by chance."""
    progress: Progress | None = None
    """Called with the images looked at so far, and in all."""


@dataclass(frozen=True)
class Discard:
    """What one discard did."""

    capacity: int
    """N from now on: a strategy may let the memory grow (E32)."""
    ids: Ids = field(default_factory=lambda: np.zeros(0, np.uint64))
    """Removed insertion numbers, ascending."""
    removed: Rows | None = None
    """Their rows as they were when they went; None without any."""
    marked: bool = False
    """Whether the strategy changed its own columns."""
    keep: Mapping[str, int] = field(default_factory=dict)
    """Whole numbers that the strategy needs again at its next discard."""
    told: Mapping[str, int] = field(default_factory=dict)
    """What a strategy tells of this discard, by name. `discard` returns all of `TELLS`."""
    warning: str = ""
    """What an operator should know; empty if nothing."""


class Strategy(ABC):
    """What is there -> what goes. Only `choose` must be written."""

    columns: ClassVar[tuple[tuple[Any, ...], ...]] = ()
    """Values of its own for each sample: (name, dtype) or (name, dtype, shape). They are 0 of new
    samples. Memory, disk and snapshots carry them, also while another strategy is in force."""

    def begin(self, config: MemoryConfig) -> dict[str, int]:
        """Return the numbers to keep that the first discard begins with."""
        return {}

    def renew(self, there: Situation) -> bool:
        """Bring its own columns up to date, for `choose`; return whether any changed."""
        return False

    def prepare(self, there: Situation) -> bool:
        """Change its own columns, whether or not the memory is full; return whether it did."""
        return False

    @abstractmethod
    def choose(self, there: Situation) -> Discard:
        """Choose what goes from a memory that holds more than N samples (A12).

        At most N must remain. Only its own columns of the memory may be changed here; `memory.kept`
        holds the numbers it kept.
        """

    def state(self, memory: ReplayMemory) -> dict[str, int]:
        """Return whole numbers that show an operator how it stands."""
        return {}

    def invariants(self, rows: Rows) -> Iterator[tuple[bool, str]]:
        """Yield what must be true of its columns: whether it is, and its name."""
        yield from ()


def beyond(before: int, total: int, progress: Progress | None) -> Progress | None:
    """Return what reports the progress of a part as that of the whole."""
    return None if progress is None else lambda done, _: progress(before + done, total)


def chances(seed: int, ids: Ids) -> Floats:
    """Return a number in [0, 1) for each sample by chance, always the same one: float64 [n]."""
    return uniform(seed, "retention", ids)


def lowest(values: Floats, count: int) -> npt.NDArray[np.int64]:
    """Return the positions of the `count` lowest values, ascending; of equal ones the first."""
    return np.sort(np.argsort(values, kind="stable")[:count])


def strategy(name: str) -> Strategy:
    """Return the strategy of this name, ours or another package's.

    Raises KeyError for an unknown one, ValueError for one with columns that is not ours: the
    memory has those of our table.
    """
    row = STRATEGIES.get(name)
    if row is None:
        added: Strategy = plugins.load(plugins.RETENTION, name)
        if added.columns:
            raise ValueError(f"strategy {name!r}: only those of the table may have columns")
        return added
    found: Strategy = getattr(import_module(f"{__package__}.{row.module}"), row.name)
    return found


def columns() -> list[tuple[Any, ...]]:
    """Return the columns of all strategies, in the order of the table; shared ones once."""
    return list(dict.fromkeys(c for name in STRATEGIES for c in strategy(name).columns))


def begin(config: MemoryConfig) -> dict[str, int]:
    """Return what all strategies begin with under these settings."""
    return {
        key: value
        for name in dict.fromkeys((*STRATEGIES, config.strategy))
        for key, value in strategy(name).begin(config).items()
    }


def discard(there: Situation) -> Discard:
    """Reduce a memory that holds more than N samples (A12, A27); remove nothing otherwise.

    Rows, capacity and kept numbers of the memory are changed.
    """
    memory, chosen = there.memory, strategy(there.config.strategy)
    memory.kept = {**begin(there.config), **memory.kept}
    prepared = chosen.prepare(there)
    done = Discard(memory.capacity)
    if len(memory) > memory.capacity:
        done = chosen.choose(there)
    if len(done.ids):
        done = replace(done, removed=memory.rows[memory.ranks(done.ids)])
        memory.remove(done.ids)
    memory.set_capacity(done.capacity)
    memory.kept |= done.keep
    told = {name: done.told.get(name, memory.kept.get(name, 0)) for name in TELLS}
    return replace(done, marked=done.marked or prepared, told=told)


def kept_in_total(capacity: int) -> int:
    """Return the samples kept in total: floor(0.99 N)."""
    return 99 * capacity // 100


def kept_of_action(capacity: int) -> int:
    """Return the samples kept of an action above its share: floor(0.99 N / 3)."""
    return 99 * capacity // (100 * ACTION_COUNT)


def surplus(memory: ReplayMemory) -> int:
    """Return how many samples must go, whichever they are."""
    return max(0, len(memory) - kept_in_total(memory.capacity))


def surplus_by_action(memory: ReplayMemory, capacity: int) -> dict[int, int]:
    """Return how many samples each action above its share of this capacity must lose."""
    if len(memory) <= capacity:
        return {}
    return {
        action: count - kept_of_action(capacity)
        for action, count in enumerate(memory.by_action())
        if ACTION_COUNT * count > capacity
    }
