"""Replay memory management: of actions above their share, samples go that look like newer ones.

A29-A34 and A44, in the reading of E17b, E19-E23, E32 and E46.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from shared.facts import ACTION_COUNT, SHORT_NAMES
from shared.rl.descriptor import BYTES, threshold_bits
from shared.rl.retention.amounts import surplus_by_action
from shared.rl.retention.strategy import Discard, Network, Rows, Situation, Strategy, beyond
from shared.rl.similarity import similar_to_newer

if TYPE_CHECKING:
    from shared.config import MemoryConfig
    from shared.rl.engine import Progress
    from shared.rl.memory import Ids, ReplayMemory

THESIS_CAPACITY = 45_000
RECOMPUTE_BELOW, RAISE_AT_MOST, CAPACITY_STEP = 1000, 2000, 5000


class RMM(Strategy):
    """Only actions above N / 3 lose samples, oldest candidates first, down to 99 % of N / 3.

    When one of them has too few candidates, all marks are computed anew, once. Too few means fewer
    than `recompute_below`, or than must go now: with N >= 45,000 the former is always the larger
    number. If one still has no more than `raise_at_most`, the capacity grows (A44, E32), at once;
    if it cannot, the threshold grows by 1 % for the next time. What candidates cannot cover goes by
    age (E21), so that len(D) <= N holds afterwards.
    """

    columns = (
        ("descriptor", "u1", (BYTES,)),
        ("described_by", "<u4"),  # weights version of the descriptor; 0: none yet
        ("candidate", "?"),
        ("forced", "?"),  # marked by decree (A44): a recomputation does not wipe it
        ("marked_by", "<u4"),
    )

    def begin(self, config: MemoryConfig) -> dict[str, int]:
        """Return the threshold of the first search."""
        return {"threshold_percent": config.threshold_percent}

    def prepare(self, there: Situation) -> bool:
        """At `mark_all_at_episode`, mark all samples stored before that episode (A44)."""
        memory, number = there.memory, there.number
        if number == 0 or number != there.config.mark_all_at_episode:
            return False
        force_candidates(memory, memory.ids[memory.rows["episode"] < number])
        return True

    def choose(self, there: Situation) -> Discard:
        """Choose the oldest candidates, after a search where there are too few of them."""
        memory, config = there.memory, there.config
        capacity, percent = memory.capacity, memory.kept["threshold_percent"]
        recomputed = _too_few_candidates(memory, config)
        if recomputed:
            recompute_marks(memory, config, threshold_bits(percent), there.network, there.progress)
            failed = _search_failed(memory, config)
            capacity = _grown_capacity(memory, config, failed)
            if failed and capacity == memory.capacity:
                percent = min(percent + 1, config.threshold_max_percent)
        ids, last_resort = _oldest_candidates(memory, surplus_by_action(memory, capacity))
        return Discard(
            capacity,
            ids,
            marked=recomputed,
            keep={"threshold_percent": percent},
            told={
                "last_resort": last_resort,
                "recomputed": int(recomputed),
                "threshold_percent": percent,
            },
            warning=f"{last_resort} samples discarded by age, candidates ran out"
            if last_resort
            else "",
        )

    def state(self, memory: ReplayMemory) -> dict[str, int]:
        """Return the threshold of the next search and the candidates of each action."""
        candidates = zip(SHORT_NAMES, candidates_by_action(memory), strict=True)
        return {
            "threshold_percent": memory.kept.get("threshold_percent", 0),
            **{f"candidates_{action}": count for action, count in candidates},
        }

    def invariants(self, rows: Rows) -> Iterator[tuple[bool, str]]:
        """Yield what must be true of marks and descriptors."""
        candidate, forced = rows["candidate"], rows["forced"]
        yield bool(np.all(candidate | ~forced)), "forced samples are candidates"
        known = ~candidate | forced | (rows["marked_by"] > 0)
        yield bool(np.all(known)), "candidates know the version that marked them"
        described = (rows["marked_by"] == 0) | (rows["described_by"] > 0)
        yield bool(np.all(described)), "marked samples have a descriptor"


STRATEGY = RMM()


def scaled_count(count: int, capacity: int) -> int:
    """Return a count of the thesis (N >= 45,000) for smaller memories: x N / 45,000 (E17b)."""
    if capacity >= THESIS_CAPACITY:
        return count
    return max(1, round(count * capacity / THESIS_CAPACITY))


def candidates_by_action(memory: ReplayMemory) -> list[int]:
    """Return the number of discard candidates of each action, marks by decree included (E46)."""
    marked = memory.rows["action"][memory.rows["candidate"]]
    return [int(n) for n in np.bincount(marked, minlength=ACTION_COUNT)]


def force_candidates(memory: ReplayMemory, ids: Ids) -> None:
    """Mark samples by decree (A44): the marks stay until the samples are discarded.

    Raises KeyError, and marks none, if one is missing.
    """
    ranks = memory.ranks(ids)
    memory.rows["forced"][ranks] = True
    memory.rows["candidate"][ranks] = True


def recompute_marks(
    memory: ReplayMemory,
    config: MemoryConfig,
    bits: int,
    network: Network,
    progress: Progress | None = None,
) -> None:
    """Mark anew, for every action, what looks like a newer sample (A30, E20).

    Descriptors already made by this weights version are used again; forced marks stay (A44).
    """
    outdated = np.flatnonzero(memory.rows["described_by"] != network.version)
    total, done = len(memory), len(memory) - len(outdated)
    for some, images in memory.parts(outdated):
        report = beyond(done, total, progress)
        memory.rows["descriptor"][some] = network.descriptors(images, report)
        memory.rows["described_by"][some] = network.version
        done += len(some)
    for action in range(ACTION_COUNT):
        own = np.flatnonzero(memory.rows["action"] == action)
        similar = similar_to_newer(memory.rows["descriptor"][own], bits, config.rule)
        memory.rows["candidate"][own] = similar | memory.rows["forced"][own]
    memory.rows["marked_by"] = network.version


def _too_few_candidates(memory: ReplayMemory, config: MemoryConfig) -> bool:
    """Return whether marks must be computed anew (A31, E20)."""
    least = config.recompute_below or scaled_count(RECOMPUTE_BELOW, memory.capacity)
    return _fewer(memory, memory.capacity, least)


def _search_failed(memory: ReplayMemory, config: MemoryConfig) -> bool:
    """Return whether some action that must discard still has too few candidates (A32, E19)."""
    most = config.raise_at_most or scaled_count(RAISE_AT_MOST, memory.capacity)
    candidates = candidates_by_action(memory)
    return any(candidates[action] <= most for action in surplus_by_action(memory, memory.capacity))


def _grown_capacity(memory: ReplayMemory, config: MemoryConfig, failed: bool) -> int:
    """Return N after a search: one step more if it failed, up to `capacity_max` (A44, E32).

    Further steps follow while candidates could not cover what must go: nothing goes by age from a
    memory that may still grow. In memories of the thesis's size one step always suffices.
    """
    step = config.capacity_step or scaled_count(CAPACITY_STEP, config.capacity)
    capacity = memory.capacity
    while capacity < config.capacity_max and (failed or _fewer(memory, capacity)):
        capacity, failed = min(capacity + step, config.capacity_max), False
    return capacity


def _fewer(memory: ReplayMemory, capacity: int, least: int = 0) -> bool:
    """Return whether an action has fewer candidates than `least` or than must go."""
    candidates = candidates_by_action(memory)
    surplus = surplus_by_action(memory, capacity)
    return any(candidates[action] < max(least, count) for action, count in surplus.items())


def _oldest_candidates(memory: ReplayMemory, surplus: dict[int, int]) -> tuple[Ids, int]:
    """Return the ids to remove, ascending, and how many of them are no candidates.

    surplus: how many of each action must go. Candidates go first, each kind oldest first.
    """
    # Reading one field of the rows runs through the bytes of all fields, so each is read once.
    ids, actions, marked = (memory.rows[name].copy() for name in ("id", "action", "candidate"))
    chosen, last_resort = [ids[:0]], 0
    for action, count in surplus.items():
        own = actions == action
        candidates = ids[own & marked][:count]
        others = ids[own & ~marked][: count - len(candidates)]
        chosen += [candidates, others]
        last_resort += count - len(candidates)
    return np.sort(np.concatenate(chosen)), last_resort
