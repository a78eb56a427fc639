"""P11: how the memory's costs grow: an RMM pass, an append and a discard, by size.

Descriptors are random, the worst case of the search: nothing is found early. The search compares
all pairs, so its time may grow with the square of the size and by nothing worse: judged is the
steepest step from one size to the next. An append with discard may grow linearly, from the smallest
to the largest size; the step at which the rows outgrow the processor's caches is steeper. Without
options the plot in docs/images is drawn anew.

    python -m benchmarks.growth [--short | --check]
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from types import SimpleNamespace

import numpy as np

from benchmarks.frame import Bar, Mode, mode_of, report, table
from shared.config import MemoryConfig
from shared.facts import IMAGE_SHAPE
from shared.provenance import ROOT
from shared.rl.memory import SAMPLE, ReplayMemory
from shared.rl.retention.rmm import recompute_marks
from shared.rl.retention.strategy import Situation, discard

EPISODE_SAMPLES = 500
BITS = 4
PLOT = ROOT / "docs" / "images" / "growth.png"
SIZES: dict[Mode, tuple[int, ...]] = {
    "check": (300, 600),
    "short": (10_000, 45_000),
    "full": (10_000, 45_000, 90_000, 250_000),
}


@dataclass(frozen=True)
class Times:
    """Median seconds at one size."""

    passed_s: float
    """Time of a whole RMM pass with known descriptors."""
    append_s: float
    """Time to append one episode to a full memory."""
    both_s: float
    """Time of the append and the discard after it, with known marks."""


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
    append_black(memory, size, draw)
    return memory


def append_black(memory: ReplayMemory, count: int, draw: np.random.Generator) -> None:
    """Append so many samples with black images."""
    while count > 0:
        some = min(5000, count)
        first = int(memory.ids[-1]) + 1 if len(memory) else 1
        memory.append(rows_of(first, some, draw), np.zeros((some, *IMAGE_SHAPE), np.uint8))
        count -= some


def measure(size: int, rounds: int) -> Times:
    """All times at one size."""
    draw, config = np.random.default_rng(size), MemoryConfig(capacity=size, recompute_below=1)
    memory = full_memory(size, draw)

    def describe(images: np.ndarray, _: object) -> np.ndarray:
        return draw.integers(0, 256, (len(images), 15), np.uint8)

    network = SimpleNamespace(version=1, descriptors=describe)
    passes = [
        seconds(lambda: recompute_marks(Situation(memory, 0, config, network, seed=1), BITS))
        for _ in range(3 if size < 100_000 else 1)
    ]
    memory.rows["candidate"], memory.rows["marked_by"] = True, 1
    images, appends, both = np.zeros((EPISODE_SAMPLES, *IMAGE_SHAPE), np.uint8), [], []
    for _ in range(rounds):
        append_black(memory, size - len(memory), draw)  # or there would be nothing to discard
        rows = rows_of(int(memory.ids[-1]) + 1, EPISODE_SAMPLES, draw)
        appends.append(seconds(lambda rows=rows: memory.append(rows, images)))
        both.append(
            appends[-1] + seconds(lambda: discard(Situation(memory, 0, config, network, seed=1)))
        )
        assert len(memory) < size
    return Times(median(passes), median(appends), median(both))


def seconds(work: Callable[[], object]) -> float:
    """What one call takes."""
    start_s = time.perf_counter()
    work()
    return time.perf_counter() - start_s


def exponents(sizes: Sequence[int], times_s: Sequence[float]) -> tuple[float, float]:
    """Exponents of growth, 1 linear, 2 the square: over all sizes, and of the steepest step."""
    log_sizes, log_times = np.log(sizes), np.log(times_s)
    steps = np.diff(log_times) / np.diff(log_sizes)
    whole = (log_times[-1] - log_times[0]) / (log_sizes[-1] - log_sizes[0])
    return float(whole), float(steps.max())


def draw_plot(figures: dict[int, Times], path: Path) -> None:
    """Times over sizes, both logarithmic, with the laws they are held against."""
    from matplotlib.figure import Figure

    sizes = np.array(list(figures))
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log")
    for label, times_s, power, mark in (
        ("RMM pass: search over all pairs of an action", [t.passed_s for t in figures.values()],
         2, "o"),
        (f"append of {EPISODE_SAMPLES} samples and discard", [t.both_s for t in figures.values()],
         1, "s"),
        (f"append of {EPISODE_SAMPLES} samples", [t.append_s for t in figures.values()], 0, "^"),
    ):  # fmt: skip
        (line,) = axes.plot(sizes, 1e3 * np.array(times_s), mark + "-", label=label)
        if power:
            law = 1e3 * times_s[-1] * (sizes / sizes[-1]) ** power
            name = {1: "linear growth", 2: "growth with the square"}[power]
            axes.plot(sizes, law, "--", color=line.get_color(), alpha=0.6, label=name)
    axes.set_xlabel("samples in memory")
    axes.set_ylabel("time in milliseconds")
    axes.set_xticks(sizes, [f"{size:,}" for size in sizes])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, draw and report."""
    mode = mode_of(arguments, __doc__)
    figures = {size: measure(size, 3 if mode == "check" else 15) for size in SIZES[mode]}
    rows: list[list[object]] = [
        [n, t.passed_s, t.passed_s / (n * (n / 3 - 1) / 2) * 1e9, t.append_s * 1e3, t.both_s * 1e3]
        for n, t in figures.items()
    ]
    if mode == "full":
        draw_plot(figures, PLOT)
    head = ["samples", "RMM pass s", "ns a pair", "append ms", "append + discard ms"]
    sizes = list(figures)
    _, passes = exponents(sizes, [t.passed_s for t in figures.values()])
    turns, step = exponents(sizes, [t.both_s for t in figures.values()])
    bars = [
        Bar("P11a", passes, "exponent", "lower", 2.1, 2.0, None, None, len(sizes)),
        Bar("P11b", turns, "exponent", "lower", 1.1, 1.0, None, None, len(sizes),
            {"steepest_step": step}),
    ]  # fmt: skip
    report("Growth", [table(head, rows)], bars)


if __name__ == "__main__":
    main()
