"""Which samples go when the memory is full, and when it grows instead (A27-A34, A44)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from shared.facts import ACTION_COUNT
from shared.rl.descriptor import threshold_bits
from shared.rl.memory import Ids, Images, ReplayMemory
from shared.rl.similarity import similar_to_newer

if TYPE_CHECKING:
    from shared.config import MemoryConfig

THESIS_CAPACITY = 45_000
RECOMPUTE_BELOW, RAISE_AT_MOST, CAPACITY_STEP = 1000, 2000, 5000
Describe = Callable[[Images], npt.NDArray[np.uint8]]
"""Descriptors uint8 [n, 15] of images under the current target network."""


def scaled_count(count: int, capacity: int) -> int:
    """A count of the thesis, which had N >= 45,000, for smaller memories: x N / 45,000 (E17b)."""
    if capacity >= THESIS_CAPACITY:
        return count
    return max(1, round(count * capacity / THESIS_CAPACITY))


def normm_keep(capacity: int) -> int:
    """Samples NoRMM keeps in total: floor(0.99 N) (A27, E22)."""
    return 99 * capacity // 100


def rmm_share(capacity: int) -> int:
    """Samples RMM keeps of an action above its share: floor(0.99 N / 3) (A33, E22)."""
    return 99 * capacity // (100 * ACTION_COUNT)


@dataclass(frozen=True)
class Discard:
    """What one discard did."""

    threshold_percent: int
    """Threshold for the next recomputation (E19)."""
    capacity: int
    """N from now on (E32); the memory has it already."""
    ids: Ids = field(default_factory=lambda: np.zeros(0, np.uint64))
    """Removed insertion numbers, ascending."""
    recomputed: bool = False
    last_resort: int = 0
    """Samples removed by age because candidates ran out (E21)."""


def discard_oldest(memory: ReplayMemory) -> Ids:
    """NoRMM: the samples to remove, oldest first, until floor(0.99 N) remain (A28)."""
    surplus = len(memory) - normm_keep(memory.capacity) if len(memory) > memory.capacity else 0
    return memory.ids[:surplus].copy()


def recompute_marks(
    memory: ReplayMemory, config: MemoryConfig, bits: int, describe: Describe, version: int
) -> None:
    """Mark anew, for every action, what looks like a newer sample (A30, E20).

    Descriptors already made by this weights version are used again; forced marks stay (A44).
    """
    outdated = np.flatnonzero(memory.rows["described_by"] != version)
    for some, images in memory.parts(outdated):
        memory.rows["descriptor"][some] = describe(images)
        memory.rows["described_by"][some] = version
    for action in range(ACTION_COUNT):
        own = np.flatnonzero(memory.rows["action"] == action)
        similar = similar_to_newer(memory.rows["descriptor"][own], bits, config.rule)
        memory.rows["candidate"][own] = similar | memory.rows["forced"][own]
    memory.rows["marked_by"] = version


def discard(
    memory: ReplayMemory,
    config: MemoryConfig,
    threshold_percent: int,
    describe: Describe,
    version: int,
) -> Discard:
    """Reduce a memory that holds more than N samples (A12, A27); do nothing otherwise.

    RMM (A31-A33, E19-E22): only actions above N / 3 lose samples, oldest candidates first, down to
    99 % of N / 3. When one of them has too few candidates, all marks are computed anew, once. Too
    few means fewer than `recompute_below`, or than must go now: with N >= 45,000 the former is
    always the larger number. If one still has no more than `raise_at_most`, the capacity grows
    (A44, E32), at once; if it cannot, the threshold grows by 1 % for the next time. What candidates
    cannot cover goes by age (E21), so that len(D) <= N holds afterwards. Marks, descriptors, rows
    and capacity of `memory` are changed.
    """
    if len(memory) <= memory.capacity:
        return Discard(threshold_percent, memory.capacity)
    if config.strategy == "normm":
        ids = discard_oldest(memory)
        memory.remove(ids)
        return Discard(threshold_percent, memory.capacity, ids)

    recomputed = _too_few_candidates(memory, config)
    if recomputed:
        bits = threshold_bits(threshold_percent)
        recompute_marks(memory, config, bits, describe, version)
        failed = _search_failed(memory, config)
        grown = _grown_capacity(memory, config, failed)
        if failed and grown == memory.capacity:
            threshold_percent = min(threshold_percent + 1, config.threshold_max_percent)
        memory.set_capacity(grown)
    removed, last_resort = _oldest_candidates(memory, _surplus(memory, memory.capacity))
    memory.remove(removed)
    return Discard(threshold_percent, memory.capacity, removed, recomputed, last_resort)


def _surplus(memory: ReplayMemory, capacity: int) -> dict[int, int]:
    """Actions that must discard with this capacity, and how many samples each (A33)."""
    if len(memory) <= capacity:
        return {}
    return {
        action: count - rmm_share(capacity)
        for action, count in enumerate(memory.by_action())
        if ACTION_COUNT * count > capacity
    }


def _too_few_candidates(memory: ReplayMemory, config: MemoryConfig) -> bool:
    """Whether marks must be computed anew (A31, E20)."""
    least = config.recompute_below or scaled_count(RECOMPUTE_BELOW, memory.capacity)
    return _fewer(memory, memory.capacity, least)


def _search_failed(memory: ReplayMemory, config: MemoryConfig) -> bool:
    """Whether some action that must discard still has too few candidates (A32, E19)."""
    most = config.raise_at_most or scaled_count(RAISE_AT_MOST, memory.capacity)
    candidates = memory.candidates_by_action()
    return any(candidates[action] <= most for action in _surplus(memory, memory.capacity))


def _grown_capacity(memory: ReplayMemory, config: MemoryConfig, failed: bool) -> int:
    """N after a search: one step more if it failed, up to `capacity_max` (A44, E32).

    Further steps follow while candidates could not cover what must go: nothing goes by age from a
    memory that may still grow. In memories of the thesis's size one step always suffices.
    """
    step = config.capacity_step or scaled_count(CAPACITY_STEP, config.capacity)
    capacity = memory.capacity
    while capacity < config.capacity_max and (failed or _fewer(memory, capacity)):
        capacity, failed = min(capacity + step, config.capacity_max), False
    return capacity


def _fewer(memory: ReplayMemory, capacity: int, least: int = 0) -> bool:
    """Whether an action has fewer candidates than `least`, or than must go with this capacity."""
    candidates = memory.candidates_by_action()
    surplus = _surplus(memory, capacity)
    return any(candidates[action] < max(least, count) for action, count in surplus.items())


def _oldest_candidates(memory: ReplayMemory, surplus: dict[int, int]) -> tuple[Ids, int]:
    """Ids to remove, ascending, and how many of them are no candidates.

    So many of each action: candidates first, each kind oldest first.
    """
    # Each look at one field of the rows runs through all their bytes: look at each once.
    ids, actions, marked = (memory.rows[name].copy() for name in ("id", "action", "candidate"))
    chosen, last_resort = [ids[:0]], 0
    for action, count in surplus.items():
        own = actions == action
        candidates = ids[own & marked][:count]
        others = ids[own & ~marked][: count - len(candidates)]
        chosen += [candidates, others]
        last_resort += count - len(candidates)
    return np.sort(np.concatenate(chosen)), last_resort
