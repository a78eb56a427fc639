"""Which samples go when the memory is full: NoRMM and RMM (section 3.5, A27-A34)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from shared.rl.descriptor import threshold_bits
from shared.rl.memory import Ids, Images, ReplayMemory
from shared.rl.policy import ACTIONS
from shared.rl.similarity import similar_to_newer

if TYPE_CHECKING:
    from shared.config import MemoryConfig

THESIS_CAPACITY = 45_000
RECOMPUTE_BELOW, RAISE_AT_MOST = 1000, 2000
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
    return 99 * capacity // (100 * ACTIONS)


@dataclass(frozen=True)
class Discard:
    """What one discard did."""

    ids: Ids = field(default_factory=lambda: np.zeros(0, np.uint64))
    """Removed insertion numbers, ascending."""
    recomputed: bool = False
    last_resort: int = 0
    """Samples removed by age because candidates ran out (E21)."""
    threshold_percent: int = 1
    """Threshold for the next recomputation (E19)."""


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
    for action in range(ACTIONS):
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
    99 % of N / 3. When one of them has too few candidates, all marks are computed anew, once; if
    one still has no more than `raise_at_most`, the threshold grows by 1 % for the next time. Too
    few means fewer than `recompute_below`, or than must go now: with N >= 45,000 the former is
    always the larger number. What candidates cannot cover goes by age (E21), so that
    len(D) <= N holds afterwards. Marks, descriptors and rows of `memory` are changed.
    """
    if len(memory) <= memory.capacity:
        return Discard(threshold_percent=threshold_percent)
    if config.strategy == "normm":
        ids = discard_oldest(memory)
        memory.remove(ids)
        return Discard(ids, threshold_percent=threshold_percent)

    share = rmm_share(memory.capacity)
    surplus = {
        action: count - share
        for action, count in enumerate(memory.by_action())
        if ACTIONS * count > memory.capacity
    }
    recomputed = _too_few_candidates(memory, config, surplus)
    if recomputed:
        bits = threshold_bits(threshold_percent)
        recompute_marks(memory, config, bits, describe, version)
        threshold_percent = _next_threshold(memory, config, surplus, threshold_percent)
    removed, last_resort = _oldest_candidates(memory, surplus)
    memory.remove(removed)
    return Discard(removed, recomputed, last_resort, threshold_percent)


def _too_few_candidates(
    memory: ReplayMemory, config: MemoryConfig, surplus: dict[int, int]
) -> bool:
    least = config.recompute_below or scaled_count(RECOMPUTE_BELOW, memory.capacity)
    candidates = memory.candidates_by_action()
    return any(candidates[action] < max(least, count) for action, count in surplus.items())


def _next_threshold(
    memory: ReplayMemory, config: MemoryConfig, surplus: dict[int, int], percent: int
) -> int:
    """One percent more when some action that must discard has too few candidates (A32, E19)."""
    most = config.raise_at_most or scaled_count(RAISE_AT_MOST, memory.capacity)
    candidates = memory.candidates_by_action()
    if any(candidates[action] <= most for action in surplus):
        return min(percent + 1, config.threshold_max_percent)
    return percent


def _oldest_candidates(memory: ReplayMemory, surplus: dict[int, int]) -> tuple[Ids, int]:
    """Ids to remove, ascending, and how many of them are no candidates.

    So many of each action: candidates first, each kind oldest first.
    """
    # Each look at one field of the rows runs through all their bytes: look at each once.
    ids, actions, marked = (memory.rows[name].copy() for name in ("id", "action", "candidate"))
    chosen, last_resort = [], 0
    for action, count in surplus.items():
        own = actions == action
        candidates = ids[own & marked][:count]
        others = ids[own & ~marked][: count - len(candidates)]
        chosen += [candidates, others]
        last_resort += count - len(candidates)
    return np.sort(np.concatenate(chosen)), last_resort
