"""P10: how much memory each process takes, with a full memory of 45,000 samples and on the CPU.

What counts is the unique set size: pages that no other process maps, which would be free if the
process ended. Figures are the largest seen while the processes of a whole system, all with the full
network, load the memory, drive, describe and mark all samples, equalise all rewards, and train.
Growth is seen in a second run, with a narrow network, a small memory and several robots, because a
hundred thousand steps take too long otherwise.

    python -m benchmarks.memory_use [--short | --check]
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from benchmarks import frames
from benchmarks.frame import Bar, Mode, mode_of, report, table
from benchmarks.prefilled import bus, fill, system
from services.launcher.supervisor import Supervisor
from services.launcher.up import free_endpoint
from services.monitor.heartbeats import Reader, Snapshot
from shared import settings
from shared.config import Config
from shared.numerics import settle_all

LIMITS_MB = {
    "learner": ("P10a", 1200.0),
    "replay": ("P10b", 600.0),
    "actor": ("P10c", 700.0),
    "driver": ("P10d", 250.0),
}
GROWTH_PERCENT = 5.0
PATIENCE_S = 1800.0
IMAGES = 4000
"""Different images in the memory; what it takes depends on their number only."""


@dataclass(frozen=True)
class Sizes:
    """How much of everything a mode takes."""

    filters: int
    capacity: int
    episodes: int
    """Turns of the full system: each describes what is outdated, equalises and trains."""
    fit_every: int
    grow_capacity: int
    warm_up_steps: int
    steps: int
    robots: int


SIZES: dict[Mode, Sizes] = {
    "check": Sizes(4, 900, 1, 0, 900, 50, 50, 1),
    "short": Sizes(64, 45_000, 1, 0, 2000, 4000, 4000, 4),
    "full": Sizes(64, 45_000, 4, 3, 2000, 20_000, 100_000, 4),
}


@dataclass(frozen=True)
class Look:
    """Unique set sizes in MB by process, and how many actions the memory had seen."""

    actions: int
    used_mb: dict[str, float]


def unique_in(rollup: str) -> float:
    """The unique set size, in MB, that the text of `/proc/PID/smaps_rollup` tells."""
    fields = dict(line.split(":", 1) for line in rollup.splitlines()[1:])
    return sum(int(fields[f"Private_{kind}"].split()[0]) for kind in ("Clean", "Dirty")) * 1.024e-3


def watched(
    config: Config, supervisor: Supervisor, done: Callable[[Snapshot], bool], every_s: float
) -> list[Look]:
    """Looks at all processes, one `every_s`, until `done`. Raises RuntimeError when one ends."""
    looks: list[Look] = []
    deadline_s = time.monotonic() + PATIENCE_S
    with bus(config) as client:
        reader = Reader(client.inbox())
        while not done(seen := reader.snapshot()):
            if supervisor.poll() or any(child.restarts for child in supervisor.statuses()):
                raise RuntimeError(f"a process ended: {supervisor.statuses()}")
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"not done within {PATIENCE_S:.0f} s")
            looks.append(Look(actions_of(seen), used_mb(supervisor)))
            time.sleep(every_s)
            reader.update()
    return looks


def actions_of(seen: Snapshot) -> int:
    """Actions of all episodes on disk."""
    return seen.replay.message.actions if seen.replay else 0


def used_mb(supervisor: Supervisor) -> dict[str, float]:
    """Unique set sizes of all processes now."""
    return {
        name: unique_in(Path(f"/proc/{pid}/smaps_rollup").read_text())
        for name, pid in supervisor.pids().items()
    }


def configuration(capacity: int, filters: int, equalise_every: int, fit_every: int) -> Config:
    """A run that chooses its arithmetic like the demo; its memory is filled beforehand."""
    chosen = {"threads": 0, "precision": "auto"}
    return Config.model_validate(
        {
            "run": {"name": "bench"},
            "bus": {"endpoint": free_endpoint()},
            "memory": {"capacity": capacity, "equalise_every": equalise_every},
            "network": {"filters": filters},
            "learning": {"fit_every": fit_every, "fit_epochs": 1},
            "numerics": {"actor": {"precision": "auto"}, "replay": chosen, "learner": chosen},
        }
    )


def prepared(folder: Path, config: Config, mode: Mode) -> Path:
    """A run folder with a full memory, and with what the roles leave open settled."""
    fill(folder, config, frames.images(mode, IMAGES))
    settle_all(settings.claim(folder, config), folder)
    return folder


def full_use(mode: Mode) -> list[Look]:
    """A whole system with a large memory, from its start to the end of some turns."""
    sizes = SIZES[mode]
    config = configuration(sizes.capacity, sizes.filters, 1, sizes.fit_every)

    def done(seen: Snapshot) -> bool:
        return seen.episodes_done >= sizes.episodes

    with tempfile.TemporaryDirectory() as place:
        folder = prepared(Path(place) / "run", config, mode)
        with system(config, folder) as supervisor:
            return watched(config, supervisor, done, every_s=0.25)


def long_use(mode: Mode) -> list[Look]:
    """A system with a narrow network and a small memory, over many steps of several robots."""
    sizes = SIZES[mode]
    config = configuration(sizes.grow_capacity, 4, equalise_every=50, fit_every=0)

    def done(seen: Snapshot) -> bool:
        return actions_of(seen) >= sizes.warm_up_steps + sizes.steps

    with tempfile.TemporaryDirectory() as place:
        folder = prepared(Path(place) / "run", config, mode)
        with system(config, folder, robots=sizes.robots) as supervisor:
            looks = watched(config, supervisor, done, every_s=0.5)
    return [look for look in looks if look.actions >= sizes.warm_up_steps]


def growth_percent(looks: Sequence[Look], name: str) -> tuple[float, float, float]:
    """Medians of one process's first and last tenth of looks, in MB, and the growth between."""
    tenth = max(1, len(looks) // 10)
    first, last = (
        median(look.used_mb[name] for look in part) for part in (looks[:tenth], looks[-tenth:])
    )
    return first, last, 100 * (last / first - 1)


def measure(mode: Mode) -> tuple[list[str], list[Bar]]:
    """Tables and bars."""
    looks, grown = full_use(mode), long_use(mode)
    use_rows: list[list[object]] = []
    bars = []
    for name, (bar, limit) in LIMITS_MB.items():
        seen = [look.used_mb[name] for look in looks]
        use_rows.append([name, max(seen), median(seen), seen[-1]])
        bars.append(Bar(bar, max(seen), "MB", "lower", limit, limit, None, None, len(seen)))
    growths = {name: growth_percent(grown, name) for name in grown[-1].used_mb}
    worst = max(growth for _, _, growth in growths.values())
    bars.append(Bar("P10e", worst, "%", "lower", GROWTH_PERCENT, GROWTH_PERCENT, None, None, 1))
    return [use_table(mode, use_rows), growth_table(mode, growths, grown)], bars


def use_table(mode: Mode, rows: list[list[object]]) -> str:
    """Unique set sizes of the full system."""
    sizes = SIZES[mode]
    fitting = "a fitting phase" if sizes.fit_every else "mini-batches"
    text = (
        f"{sizes.filters} filters, {sizes.capacity} samples, {sizes.episodes} episodes with new "
        f"descriptors, equalisation and {fitting}"
    )
    head = ["unique set size", "largest MB", "median MB", "last MB"]
    return f"{text}\n\n{table(head, rows)}"


def growth_table(
    mode: Mode, growths: dict[str, tuple[float, float, float]], looks: Sequence[Look]
) -> str:
    """Unique set sizes of the narrow system early and late."""
    sizes = SIZES[mode]
    steps = looks[-1].actions - looks[0].actions
    text = (
        f"4 filters, {sizes.grow_capacity} samples, {sizes.robots} robots, {steps} steps after "
        f"{looks[0].actions} that do not count"
    )
    head = ["growth", "first tenth MB", "last tenth MB", "%"]
    return f"{text}\n\n{table(head, [[name, *growths[name]] for name in growths])}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and report."""
    tables, bars = measure(mode_of(arguments, __doc__))
    report("Memory use", tables, bars)


if __name__ == "__main__":
    main()
