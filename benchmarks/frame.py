"""What all benchmarks share: sizes, interleaved rounds, the table, and the last line for programs.

A benchmark runs its baseline and ours in turns (A B A B ...) in one process, so that whatever else
happens on the machine meets both, and compares medians. Its last line is one JSON list of bars.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from statistics import median
from typing import Any, Literal

from shared.provenance import machine

Mode = Literal["check", "short", "full"]
Better = Literal["higher", "lower"]
Times = dict[str, list[float]]


@dataclass(frozen=True)
class Bar:
    """One figure that is held against what is required and aimed at."""

    id: str
    value: float
    unit: str
    better: Better
    required: float
    aim: float
    baseline_median: float | None
    ours_median: float | None
    n: int
    checks: dict[str, float] = field(default_factory=dict)
    """Figures of correctness that belong to it, such as a gradient's cosine."""

    def reaches(self, limit: float) -> bool:
        """Whether the value is at least as good as `limit`."""
        return self.value >= limit if self.better == "higher" else self.value <= limit

    @property
    def verdict(self) -> str:
        """How the value stands to the bar, in one word or two."""
        if self.reaches(self.aim):
            return "aim met"
        return "met" if self.reaches(self.required) else "short"


def speedup(
    name: str, baseline: Sequence[float], ours: Sequence[float], required: float, aim: float
) -> Bar:
    """A bar on how many times faster ours is: the ratio of medians, whose times are in ms."""
    plain, own = median(baseline) * 1e3, median(ours) * 1e3
    return Bar(name, plain / own, "x", "higher", required, aim, plain, own, len(ours))


def mode_of(arguments: Sequence[str] | None, description: str | None) -> Mode:
    """The mode a script was started in: full unless it is told otherwise."""
    parser = argparse.ArgumentParser(description=description)
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--short", action="store_true", help="fewer rounds and images")
    group.add_argument("--check", action="store_true", help="tiny: does it run at all")
    given = parser.parse_args(arguments)
    return "short" if given.short else "check" if given.check else "full"


def rounds_of(mode: Mode, short: int, full: int) -> int:
    """Rounds to measure; two where only the running is checked."""
    return {"check": 2, "short": short, "full": full}[mode]


def interleaved(
    cases: Mapping[str, Callable[[], object]], rounds: int, warm_up: int = 1
) -> dict[str, list[float]]:
    """Seconds of each case, `rounds` times in turns, after `warm_up` rounds that do not count."""
    times: Times = {name: [] for name in cases}
    for number in range(warm_up + rounds):
        for name, case in cases.items():
            start_s = time.perf_counter()
            case()
            spent_s = time.perf_counter() - start_s
            if number >= warm_up:
                times[name].append(spent_s)
    return times


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Rows under a head as Markdown, columns aligned; floats with three significant digits."""
    cells = [list(head), *([_cell(value) for value in row] for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    lines = ["| " + " | ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) + " |"
             for row in cells]  # fmt: skip
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join(lines)


def times_table(times: Times, baseline: str) -> str:
    """Median and best time of each case and how many times faster than the baseline it is."""
    plain = median(times[baseline])
    rows = [
        [name, median(spent) * 1e3, min(spent) * 1e3, plain / median(spent)]
        for name, spent in times.items()
    ]
    return table(["case", "median ms", "best ms", f"times {baseline}"], rows)


def report(title: str, tables: Sequence[str], bars: Sequence[Bar]) -> None:
    """Print what was found, tables first, and the bars as the last line."""
    print(f"# {title}\n")
    print("  ".join(f"{key}: {value}" for key, value in machine().items()), end="\n\n")
    for each in tables:
        print(each, end="\n\n")
    print(bars_table(bars), end="\n\n")
    print(json.dumps([as_json(bar) for bar in bars]), flush=True)


def bars_table(bars: Sequence[Bar]) -> str:
    """Bars with their verdicts."""
    head = ["id", "value", "unit", "required", "aim", "verdict", "baseline", "ours", "n", "checks"]
    return table(head, [bar_row(bar) for bar in bars])


def bar_row(bar: Bar) -> list[object]:
    """The cells of one bar."""
    checks = ", ".join(f"{name} {value:.6g}" for name, value in bar.checks.items())
    return [
        bar.id, bar.value, bar.unit, bar.required, bar.aim, bar.verdict,
        bar.baseline_median, bar.ours_median, bar.n, checks,
    ]  # fmt: skip


def as_json(bar: Bar) -> dict[str, Any]:
    """A bar for the last line; `checks` only where there are any."""
    tree = asdict(bar)
    if not bar.checks:
        del tree["checks"]
    return tree


def from_json(tree: dict[str, Any]) -> Bar:
    """A bar of a last line. Raises TypeError when fields are missing or unknown."""
    return Bar(**tree)


def _cell(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return str(value)
