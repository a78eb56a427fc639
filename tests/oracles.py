"""The rules of the thesis once more, as plain loops over plain lists: slow, short, independent."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction


def rewards(
    places: Sequence[tuple[float, float]],
    next_max_q: Sequence[float],
    bump: bool,
    horizon: int,
    max_distance: float,
) -> list[float]:
    """Eq 3.1-3.3 with E2, E5, E6, E7; with a bump the last sample is the terminal one, t_b."""
    t_b = len(places) - 1
    result = []
    for t in range(len(next_max_q)):
        if bump and t == t_b:
            result.append(-1.0)
            continue
        k = min(t_b, t + horizon) if bump else t + horizon
        farthest = 0.0
        for i in range(t + 1, k + 1):
            dx, dy = places[t][0] - places[i][0], places[t][1] - places[i][1]
            farthest = max(farthest, math.sqrt(dx * dx + dy * dy))
        eucl_dist = min(farthest / max_distance, 1.0)
        bump_dist = -(0.9 ** (t_b - t)) if bump and t_b - t < horizon else 0.0
        result.append(0.8 * (eucl_dist + bump_dist) + 0.2 * next_max_q[t])
    return result


def distance(a: bytes, b: bytes) -> int:
    """Hamming distance."""
    return sum((x ^ y).bit_count() for x, y in zip(a, b, strict=True))


def marks(descriptors: Sequence[bytes], bits: int, rule: str) -> list[bool]:
    """A30 with E1 and E23, of samples of one action, oldest first."""
    marked = [False] * len(descriptors)
    for older in reversed(range(len(descriptors))):
        for newer in range(older + 1, len(descriptors)):
            if rule == "cover" and marked[newer]:
                continue
            if distance(descriptors[older], descriptors[newer]) <= bits:
                marked[older] = True
    return marked


BITS_OF_PERCENT = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 7, 7: 8}
"""E18."""


@dataclass
class Sample:
    """What the rules of retention look at."""

    id: int
    action: int
    descriptor: bytes
    candidate: bool = False
    forced: bool = False


@dataclass
class Outcome:
    """What a discard did, by the rules."""

    removed: list[int] = field(default_factory=list)
    recomputed: bool = False
    last_resort: int = 0
    percent: int = 1
    capacity: int = 0


def scaled(count: int, capacity: int) -> int:
    """E17b."""
    if capacity >= 45000:
        return count
    return max(1, round(Fraction(count * capacity, 45000)))


def discard(
    samples: list[Sample],
    capacity: int,
    percent: int,
    *,
    strategy: str = "rmm",
    rule: str = "paper",
    percent_max: int = 7,
    recompute_below: int = 0,
    raise_at_most: int = 0,
    capacity_max: int = 0,
    capacity_step: int = 0,
    bits_of: Callable[[int], int] = BITS_OF_PERCENT.__getitem__,
) -> Outcome:
    """A27-A33, A44 with E17b, E19-E22, E32. `samples` (oldest first) loses what is removed.

    capacity: in force; capacity_step: never 0 where capacity_max is not.
    """
    outcome = Outcome(percent=percent, capacity=capacity)
    if len(samples) <= capacity:
        return outcome
    if strategy == "normm":
        keep = math.floor(Fraction(99, 100) * capacity)
        outcome.removed = [s.id for s in samples[: len(samples) - keep]]
    else:
        _rmm(
            samples,
            outcome,
            rule,
            percent_max,
            bits_of,
            recompute_below or scaled(1000, capacity),
            raise_at_most or scaled(2000, capacity),
            list(range(capacity + capacity_step, capacity_max, capacity_step or 1))
            + [capacity_max] * (capacity < capacity_max),
        )
    gone = set(outcome.removed)
    samples[:] = [s for s in samples if s.id not in gone]
    return outcome


def _rmm(
    samples: list[Sample],
    outcome: Outcome,
    rule: str,
    percent_max: int,
    bits_of: Callable[[int], int],
    recompute_below: int,
    raise_at_most: int,
    larger: list[int],
) -> None:
    """larger: the capacities that may still come, in this order."""
    of = {a: [s for s in samples if s.action == a] for a in range(3)}

    def excess() -> dict[int, int]:
        if len(samples) <= outcome.capacity:
            return {}
        third = Fraction(outcome.capacity, 3)
        quota = math.floor(Fraction(99, 100) * third)
        return {a: len(of[a]) - quota for a in range(3) if Fraction(len(of[a])) > third}

    def found(action: int) -> int:
        return sum(s.candidate for s in of[action])

    # E20, and E21: a search comes before the last resort.
    if any(found(a) < recompute_below or found(a) < n for a, n in excess().items()):
        outcome.recomputed = True
        for a in range(3):
            similar = marks([s.descriptor for s in of[a]], bits_of(outcome.percent), rule)
            for s, like_newer in zip(of[a], similar, strict=True):
                s.candidate = like_newer or s.forced
        if any(found(a) <= raise_at_most for a in excess()):
            if larger:
                outcome.capacity = larger.pop(0)
            else:
                outcome.percent = min(outcome.percent + 1, percent_max)
        while larger and any(found(a) < n for a, n in excess().items()):
            outcome.capacity = larger.pop(0)
    for a, n in excess().items():
        queue = [s for s in of[a] if s.candidate] + [s for s in of[a] if not s.candidate]
        outcome.removed += [s.id for s in queue[:n]]
        outcome.last_resort += sum(not s.candidate for s in queue[:n])
    outcome.removed.sort()
