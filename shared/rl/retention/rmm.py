"""Replay memory management: of actions above their share, samples go that look like newer ones.

A29-A34 and A44, in the reading of E17b, E19-E23, E32 and E46.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from shared.facts import ACTION_COUNT, SHORT_NAMES
from shared.rl.descriptor import BITS, threshold_bits
from shared.rl.retention.columns import DESCRIBED, renew_descriptors
from shared.rl.retention.strategy import (
    Discard,
    Rows,
    Situation,
    Strategy,
    kept_in_total,
    surplus_by_action,
)
from shared.rl.similarity import Descriptors, Mask, similar_to_newer

if TYPE_CHECKING:
    from shared.config import MemoryConfig
    from shared.rl.memory import Ids, ReplayMemory

THESIS_CAPACITY = 45_000
RECOMPUTE_BELOW, RAISE_AT_MOST, CAPACITY_STEP = 1000, 2000, 5000
Rule = Literal["paper", "cover"]
Search = Callable[[Descriptors, int, Rule], Mask]
"""(descriptors of one action, bits, rule) -> which of them are candidates."""


class Part(NamedTuple):
    """Samples of which some must go."""

    own: Mask
    """Which samples of the memory these are: bool [n]."""
    surplus: int
    """How many of them must go."""


class RMM(Strategy):
    """Only actions above N / 3 lose samples, oldest candidates first, down to 99 % of N / 3.

    When one of them has too few candidates, all marks are computed anew, once. Too few means fewer
    than `recompute_below`, or than must go now: with N >= 45,000 the former is always the larger
    number. If one still has no more than `raise_at_most`, the capacity grows (A44, E32), at once;
    if it cannot, the threshold grows by 1 % for the next time. What candidates cannot cover goes by
    age (E21), so that len(D) <= N holds afterwards.
    """

    columns = (
        *DESCRIBED,
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
        recomputed = self._too_few_candidates(memory, config)
        if recomputed:
            recompute_marks(there, self._bits(there, percent), self.similar)
            failed = self._search_failed(memory, config)
            capacity = self._grown_capacity(memory, config, failed)
            if failed and capacity == memory.capacity:
                percent = min(percent + 1, config.threshold_max_percent)
        ids, last_resort = _oldest_candidates(memory, self.losing(memory, capacity))
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

    def losing(self, memory: ReplayMemory, capacity: int) -> list[Part]:
        """Return the samples that must become fewer under this capacity, in parts that each must.

        They are those of each action above its share.
        """
        actions, surplus = memory.rows["action"].copy(), surplus_by_action(memory, capacity)
        return [Part(actions == action, count) for action, count in surplus.items()]

    def similar(self, descriptors: Descriptors, bits: int, rule: Rule) -> Mask:
        """Mark samples of one action, oldest first, that look like a newer one: bool [n]."""
        return similar_to_newer(descriptors, bits, rule)

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

    def _bits(self, there: Situation, percent: int) -> int:
        """In how many bits two similar samples may differ: by the threshold, or `mark_share`."""
        memory, config, bits = there.memory, there.config, threshold_bits(percent)
        if config.mark_share > 0.0:
            renew_descriptors(there)
            own = np.any([part.own for part in self.losing(memory, memory.capacity)], axis=0)
            bits = least_bits(memory, own, config, self.similar)
        return bits

    def _too_few_candidates(self, memory: ReplayMemory, config: MemoryConfig) -> bool:
        """Return whether marks must be computed anew (A31, E20)."""
        least = config.recompute_below or scaled_count(RECOMPUTE_BELOW, memory.capacity)
        return self._fewer(memory, memory.capacity, least)

    def _search_failed(self, memory: ReplayMemory, config: MemoryConfig) -> bool:
        """Return whether a part that must lose samples has too few candidates (A32, E19)."""
        most = config.raise_at_most or scaled_count(RAISE_AT_MOST, memory.capacity)
        marked = memory.rows["candidate"]
        losing = self.losing(memory, memory.capacity)
        return any(np.count_nonzero(marked[own]) <= most for own, _ in losing)

    def _grown_capacity(self, memory: ReplayMemory, config: MemoryConfig, failed: bool) -> int:
        """Return N after a search: one step more if it failed, up to `capacity_max` (A44, E32).

        Further steps follow while candidates could not cover what must go: nothing goes by age from
        a memory that may still grow. In memories of the thesis's size one step always suffices.
        """
        step = config.capacity_step or scaled_count(CAPACITY_STEP, config.capacity)
        capacity = memory.capacity
        while capacity < config.capacity_max and (failed or self._fewer(memory, capacity)):
            capacity, failed = min(capacity + step, config.capacity_max), False
        return capacity

    def _fewer(self, memory: ReplayMemory, capacity: int, least: int = 0) -> bool:
        """Return whether a part has fewer candidates than `least` or than must go."""
        marked = memory.rows["candidate"]
        losing = self.losing(memory, capacity)
        return any(np.count_nonzero(marked[own]) < max(least, surplus) for own, surplus in losing)


class Novelty(RMM):
    """The mirror of RMM: of two similar samples of one action the newer is the candidate.

    Quotas, thresholds, counts and the order in which candidates go, oldest first, are those of RMM.
    """

    def similar(self, descriptors: Descriptors, bits: int, rule: Rule) -> Mask:
        """Mark samples of one action that look like an older one: bool [n]."""
        return similar_to_newer(descriptors[::-1], bits, rule)[::-1]


class RMMTotal(RMM):
    """RMM without quotas: candidates go whatever their action, until floor(0.99 N) samples remain.

    Too few candidates are too few of all actions together.
    """

    def losing(self, memory: ReplayMemory, capacity: int) -> list[Part]:
        """Return the whole memory and how much of it must go; nothing if it fits."""
        if len(memory) <= capacity:
            return []
        return [Part(np.ones(len(memory), np.bool_), len(memory) - kept_in_total(capacity))]


STRATEGY, NOVELTY, RMM_TOTAL = RMM(), Novelty(), RMMTotal()


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


def recompute_marks(there: Situation, bits: int, search: Search = similar_to_newer) -> None:
    """Mark anew, for every action, what looks like a newer sample (A30, E20).

    Descriptors that are up to date are used again; forced marks stay (A44).
    """
    renew_descriptors(there)
    memory = there.memory
    similar = _similar(memory, bits, there.config.rule, search)
    memory.rows["candidate"] = similar | memory.rows["forced"]
    memory.rows["marked_by"] = there.network.version


def least_bits(memory: ReplayMemory, own: Mask, config: MemoryConfig, search: Search) -> int:
    """Return the least number of bits at which `mark_share` of some samples are candidates.

    own: which samples these are, bool [n]. All 120 bits if no number suffices.
    """

    def enough(bits: int, rule: Rule) -> bool:
        marked = _similar(memory, bits, rule, search) | memory.rows["forced"]
        return bool(np.mean(marked[own]) >= config.mark_share)

    low, high = 0, BITS
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if enough(middle, "paper") else (middle + 1, high)
    # The rule "cover" marks some of what "paper" marks, and not always more at more bits.
    while config.rule == "cover" and low < BITS and not enough(low, "cover"):
        low += 1
    return low


def _similar(memory: ReplayMemory, bits: int, rule: Rule, search: Search) -> Mask:
    """What the search finds among the samples of each action: bool [n]."""
    similar = np.zeros(len(memory), np.bool_)
    for action in range(ACTION_COUNT):
        own = np.flatnonzero(memory.rows["action"] == action)
        similar[own] = search(memory.rows["descriptor"][own], bits, rule)
    return similar


def _oldest_candidates(memory: ReplayMemory, losing: list[Part]) -> tuple[Ids, int]:
    """Return the ids to remove, ascending, and how many of them are no candidates.

    Of each part candidates go first, each kind oldest first.
    """
    # Reading one field of the rows runs through the bytes of all fields, so each is read once.
    ids, marked = (memory.rows[name].copy() for name in ("id", "candidate"))
    chosen, last_resort = [ids[:0]], 0
    for own, count in losing:
        candidates = ids[own & marked][:count]
        others = ids[own & ~marked][: count - len(candidates)]
        chosen += [candidates, others]
        last_resort += count - len(candidates)
    return np.sort(np.concatenate(chosen)), last_resort
