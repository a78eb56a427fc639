"""What `corridor retention` does: checks its options and works through the benchmark."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from experiments.retention.benchmark import Benchmark, Work, load_benchmark
from experiments.retention.work import measure, measured_path
from shared.errors import ConfigError

OUT = Path("runs") / "retention"
"""Default folder of streams and results."""


def run(
    setting: str, seeds: Sequence[int], entries: Sequence[str], out: Path | None, console: Console
) -> int:
    """Measure; return 0, or 1 when stopped before the end.

    Args:
        setting: Name of a setting.
        seeds: Seeds; empty: all of the benchmark.
        entries: Names of entries; empty: all.
        out: Folder of streams and results.
        console: Where progress is shown.

    Raises:
        ConfigError: There is no such setting or entry.
        CorridorError: A stream cannot be recorded or read.
    """
    benchmark, folder = load_benchmark(), out or OUT
    work = chosen(benchmark, setting, seeds, entries)
    stop = [False]

    def stopping(*_: object) -> None:
        stop[0] = True
        console.print("stopping; the same command goes on")

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stopping)
    done = sum(measured_path(folder, piece).exists() for piece in work)
    console.print(f"{len(work)} measurements, {done} of them done; results in {folder}")
    return 0 if measure(benchmark, work, folder, console.print, lambda: stop[0]) else 1


def chosen(
    benchmark: Benchmark, setting: str, seeds: Sequence[int], entries: Sequence[str]
) -> list[Work]:
    """Return the work, seed by seed. Raises ConfigError."""
    known = {entry.name for entry in benchmark.entries}
    if unknown := set(entries) - known:
        expected = ", ".join(sorted(known))
        raise ConfigError(f"--entry: expected one of {expected}, got {unknown.pop()!r}")
    found = benchmark.setting(setting)
    return [
        Work(found, entry, seed)
        for seed in seeds or range(1, benchmark.primary_seeds + 1)
        for entry in benchmark.entries_of(found, seed)
        if not entries or entry.name in entries
    ]
