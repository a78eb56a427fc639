"""How many samples stay: 99 % of the capacity, or of each action's share of it (A27, A33, E22)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from shared.facts import ACTION_COUNT

if TYPE_CHECKING:
    from shared.rl.memory import ReplayMemory


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
