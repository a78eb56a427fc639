"""Whether anything grows: many starts of the services against one router that stays, many steps.

After each start so many steps are driven in lockstep. Measured are every process (unique set size,
locked memory, open files) at its end, the standing router, /dev/shm and the run's folder when the
services are gone. What it has found lies in the folder, and the next call goes on from there. The
growth is that of the medians of the last tenth of the starts against the tenth after the warm-up.
That of the folder is told and not judged, because each episode leaves its row and its record.

    python -m benchmarks.soak --folder DIR [--starts 200] [--steps 500000] [--check]
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from benchmarks.frame import table
from benchmarks.memory_use import actions_of, unique_in, watched
from benchmarks.prefilled import system
from benchmarks.waiting import wait_until
from services.launcher.up import free_endpoint
from services.monitor.heartbeats import Snapshot
from services.processes import COMMAND, ROUTER
from shared.config import Config
from shared.numerics import settle_all
from shared.settings import claim

SERVICES = ("replay", "learner", "actor", "driver")
MOST_PERCENT = 2.0
WARM_UP = 0.2
"""Share of the starts after which nothing may grow."""
FOUND = "soak.jsonl"
SHARED_MEMORY = "/dev/shm"  # noqa: S108
Look = dict[str, float]


def configuration(endpoint: str) -> Config:
    """A narrow network and a small memory, so that most of the time is spent on steps."""
    plain = {"engine": "torch", "precision": "float32", "threads": 1}
    return Config.model_validate(
        {
            "run": {"name": "soak"},
            "bus": {"endpoint": endpoint},
            "network": {"filters": 4},
            "memory": {"capacity": 200, "equalise_every": 0},
            "episode": {"max_samples": 40, "horizon": 10},
            "learning": {"fit_every": 0, "batch_size": 16},
            "numerics": dict.fromkeys(("actor", "replay", "learner"), plain),
        }
    )


def of_process(name: str, pid: int) -> Look:
    """What a process holds now."""
    place = Path(f"/proc/{pid}")
    status = dict(line.split(":", 1) for line in (place / "status").read_text().splitlines())
    return {
        f"{name} memory MB": unique_in((place / "smaps_rollup").read_text()),
        f"{name} locked kB": float(status["VmLck"].split()[0]),
        f"{name} open files": float(len(os.listdir(place / "fd"))),
    }


def of_machine(folder: Path) -> Look:
    """What is held when the services are gone."""
    files = [path.stat() for path in (folder / "run").rglob("*") if path.is_file()]
    return {
        "shared memory MB": shutil.disk_usage(SHARED_MEMORY).used / 1e6,
        "folder MB": sum(512 * file.st_blocks for file in files) / 1e6,
        "folder files": float(len(files)),
    }


def one_start(config: Config, folder: Path, router: int, steps: int) -> Look:
    """Start the services, drive so many steps, stop them; what was held at the end."""
    look: Look = {}
    before: list[int] = []

    def done(seen: Snapshot) -> bool:
        if seen.replay is not None and not before:
            before.append(actions_of(seen))
        return bool(before) and actions_of(seen) >= before[0] + steps

    with system(config, folder / "run", SERVICES) as supervisor:
        watched(config, supervisor, done, every_s=0.5)
        for name, pid in supervisor.pids().items():
            look |= of_process(name, pid)
    return look | of_process("router", router) | of_machine(folder)


def found_in(folder: Path) -> list[Look]:
    """The looks of earlier calls."""
    path = folder / FOUND
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def growth_percent(looks: Sequence[Look], what: str) -> float:
    """How much more there is at the end than after the warm-up; from nothing counts as 100."""
    counted = looks[int(WARM_UP * len(looks)) :]
    tenth = max(1, len(counted) // 10)
    first, last = (median(look[what] for look in p) for p in (counted[:tenth], counted[-tenth:]))
    return 100.0 * (last / first - 1.0) if first else 100.0 * bool(last)


def soak(folder: Path, starts: int, steps: int) -> list[Look]:
    """All looks, those of earlier calls included; the router stands for those of this call."""
    folder.mkdir(parents=True, exist_ok=True)
    config = configuration(free_endpoint())
    settle_all(claim(folder / "run", config), folder / "run")
    command = [*COMMAND, ROUTER.name, "--listen", config.bus.endpoint]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as router:
        try:
            assert router.stdout is not None
            wait_until(router.stdout.readline, 60, "a router")
            while len(found_in(folder)) < starts:
                look = one_start(config, folder, router.pid, steps // starts)
                with (folder / FOUND).open("a") as file:
                    file.write(json.dumps(look) + "\n")
        finally:
            router.terminate()
    return found_in(folder)


def main(arguments: Sequence[str] | None = None) -> None:
    """Go on, and report; the exit code is 1 if something has grown by more than it may."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, help="where run and findings lie, for a next call")
    parser.add_argument("--starts", type=int, default=200)
    parser.add_argument("--steps", type=int, default=500_000, help="of all starts together")
    parser.add_argument("--check", action="store_true", help="two starts: does it run at all")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as place:
        starts, steps = (2, 100) if given.check else (given.starts, given.steps)
        looks = soak(given.folder or Path(place), starts, steps)
    grown = {what: growth_percent(looks, what) for what in looks[-1]}
    rows = [[what, looks[0][what], looks[-1][what], grown[what]] for what in grown]
    print(table(["what", "first", "last", "growth %"], rows))
    judged = [what for what in grown if not what.startswith("folder")]
    worst = max(judged, key=grown.__getitem__)
    print(f"largest growth: {worst}, {grown[worst]:.1f} % (bar: {MOST_PERCENT} %)")
    if grown[worst] > MOST_PERCENT and not given.check:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
