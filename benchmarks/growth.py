"""P11: how the memory's costs grow: an RMM pass and an append with discard, by size.

Descriptors are random, the worst case of the search: nothing is found early. The search compares
all pairs, so its time may grow with the square of the size and by nothing worse.

    python -m benchmarks.growth [--short | --check]
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from statistics import median

import numpy as np

from benchmarks.frame import Bar, Mode, mode_of, report, table
from shared.config import MemoryConfig
from shared.rl.memory import SAMPLE, ReplayMemory
from shared.rl.retention import discard, recompute_marks

EPISODE_SAMPLES = 500
BITS = 4
SIZES = {
    "check": (300, 600),
    "short": (10_000, 45_000),
    "full": (10_000, 45_000, 90_000, 250_000),
}


def rows_of(first: int, count: int, draw: np.random.Generator) -> np.ndarray:
    """Samples with random descriptors that count as made by version 1."""
    rows = np.zeros(count, SAMPLE)
    rows["id"] = np.arange(first, first + count)
    rows["action"] = rows["id"] % 3
    rows["descriptor"] = draw.integers(0, 256, (count, 15), np.uint8)
    rows["described_by"] = 1
    return rows


def full_memory(size: int, draw: np.random.Generator) -> ReplayMemory:
    """A memory of exactly `size` samples; all images are black."""
    memory = ReplayMemory(size)
    memory.worlds = ["plus"]
    for first in range(0, size, 5000):
        count = min(5000, size - first)
        memory.append(rows_of(first + 1, count, draw), np.zeros((count, 50, 75), np.uint8))
    return memory


def measure(size: int, rounds: int) -> tuple[float, float]:
    """Seconds of a whole RMM pass, and median seconds of append and discard of one episode."""
    draw, config = np.random.default_rng(size), MemoryConfig(capacity=size, recompute_below=1)
    memory = full_memory(size, draw)

    def describe(images: np.ndarray) -> np.ndarray:
        return draw.integers(0, 256, (len(images), 15), np.uint8)

    start_s = time.perf_counter()
    recompute_marks(memory, config, BITS, describe, 1)
    passed_s = time.perf_counter() - start_s
    memory.rows["candidate"], memory.rows["marked_by"] = True, 1
    spent = []
    for number in range(rounds):
        rows = rows_of(size + 1 + number * EPISODE_SAMPLES, EPISODE_SAMPLES, draw)
        images = np.zeros((EPISODE_SAMPLES, 50, 75), np.uint8)
        start_s = time.perf_counter()
        memory.append(rows, images)
        discard(memory, config, 1, describe, 1)
        spent.append(time.perf_counter() - start_s)
    return passed_s, median(spent)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and report."""
    mode: Mode = mode_of(arguments, __doc__)
    sizes, rounds = SIZES[mode], 3 if mode == "check" else 15
    figures = {size: measure(size, rounds) for size in sizes}
    rows: list[list[object]] = [
        [size, passed, passed / (size * (size / 3 - 1) / 2) * 1e9, spent * 1e3]
        for size, (passed, spent) in figures.items()
    ]
    small, large = sizes[0], sizes[-1]
    exponent = float(np.log(figures[large][0] / figures[small][0]) / np.log(large / small))
    head = ["samples", "RMM pass s", "ns a pair", "append + discard ms"]
    bar = Bar("P11", exponent, "exponent", "lower", 2.1, 2.0, None, exponent, len(sizes))
    report("Growth", [table(head, rows)], [bar])


if __name__ == "__main__":
    main()
