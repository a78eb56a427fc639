"""Where a step spends its time: part by part in one process, process by process in the system.

Processor time of every thread is what Linux counts, over some thousand lockstep steps with the full
network and training off, as in `benchmarks.distribution`. What is left of a step's duration is
waiting: for another process, or to be let on a core. Renews its table in docs/performance.md.

    python -m benchmarks.step_profile [--short | --check]
"""

from __future__ import annotations

import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any

from benchmarks.distribution import WARM_UP_STEPS, Steps, configuration, connected, more_robots
from benchmarks.frame import Mode, mode_of, table
from benchmarks.run_all import PAGE, renewed
from experiments.single_process import SingleProcess
from services.launcher.supervisor import Supervisor
from services.launcher.up import child_specs, free_endpoint
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import load_world
from shared import settings
from shared.config import Config
from shared.provenance import machine

ROBOTS = (1, 4)
ZENOH = ("rx-", "tx-", "acc-", "app-", "net-")
"""How Zenoh names its threads."""
TICKS_PER_S = os.sysconf("SC_CLK_TCK")


def main(arguments: Sequence[str] | None = None) -> None:
    mode = mode_of(arguments, __doc__)
    config = configuration(filters=4 if mode == "check" else 64)
    steps = {"check": 50, "short": 2000, "full": 5000}[mode]
    actor = config.numerics.actor
    parts = [f"`{' '.join(['python -m benchmarks.step_profile', *flags(mode)])}`, " + said()]
    parts += [f"In one process ({actor.engine}, {actor.precision}):", in_one_process(config, steps)]
    for robots in ROBOTS if mode != "check" else ROBOTS[:1]:
        parts += [f"The system, robots: {robots}:", in_the_system(config, steps, robots)]
    text = "\n\n".join(parts)
    print(text)
    if mode != "check":
        PAGE.write_text(renewed(PAGE.read_text(), text, "profile"))


def flags(mode: Mode) -> list[str]:
    return [] if mode == "full" else [f"--{mode}"]


def said() -> str:
    """The machine in one line."""
    return ", ".join(f"{key} {value}" for key, value in machine().items())


# ------------------------------------------------------------------------- one process


def in_one_process(config: Config, steps: int) -> str:
    """Milliseconds a step of the parts that the loop is made of."""
    robot = SimRobot(config.robot, load_world(config.robot.world), config.run.seed)
    loop, spent = SingleProcess(config, robot), Counter[str]()
    timed(robot, "sense", "camera: render and preprocess", spent)
    timed(robot, "run", "motion and contact, recovery included", spent)
    timed(loop.acting, "all_values", "network: values of all actions", spent)
    timed(loop, "_turn", "storing episodes", spent)
    turns = loop.run()
    while loop.actor.actions < WARM_UP_STEPS:
        next(turns)
    spent.clear()
    start_s, before = time.perf_counter(), loop.actor.actions
    while (done := loop.actor.actions - before) < steps:
        next(turns)
    whole_s = time.perf_counter() - start_s
    robot.close()
    spent["all else"] = whole_s - sum(spent.values())  # type: ignore[assignment]
    rows = [[name, s / done * 1e3, f"{s / whole_s:.0%}"] for name, s in spent.most_common()]
    return table(["part", "ms a step", "share"], [*rows, ["whole step", whole_s / done * 1e3, ""]])


def timed(thing: Any, method: str, name: str, spent: Counter[str]) -> None:
    """Let a method of this object count its seconds."""
    plain: Callable[..., Any] = getattr(thing, method)

    @wraps(plain)
    def measured(*given: Any, **named: Any) -> Any:
        start_s = time.perf_counter()
        try:
            return plain(*given, **named)
        finally:
            spent[name] += time.perf_counter() - start_s  # type: ignore[assignment]

    setattr(thing, method, measured)


# ------------------------------------------------------------------------- the system


def in_the_system(config: Config, steps: int, robots: int) -> str:
    """Processor milliseconds a step, by process and kind of thread."""
    with tempfile.TemporaryDirectory() as place:
        folder, endpoint = Path(place) / "run", free_endpoint()
        config = config.model_copy(
            update={"bus": config.bus.model_copy(update={"endpoint": endpoint})}
        )
        stored = settings.claim(folder, config)
        specs = child_specs(config, stored, folder, endpoint)
        specs += [more_robots(specs, f"robotino{i}") for i in range(2, robots + 1)]
        (folder / "logs").mkdir(exist_ok=True)
        with (
            Supervisor(specs, folder / "logs", dict(os.environ), []) as supervisor,
            connected(config) as client,
        ):
            counted = Steps(client.inbox())
            counted.reach(WARM_UP_STEPS, robots)
            before, start_s, first = ticks(supervisor), time.perf_counter(), counted.look()
            counted.reach_in_all(first + steps)
            done, spent_s = counted.look() - first, time.perf_counter() - start_s
            used = {name: ticks(supervisor)[name] - was for name, was in before.items()}
    return processes_table(used, done, spent_s)


def processes_table(used: dict[str, Counter[str]], steps: int, spent_s: float) -> str:
    """One row per process; the drivers of further robots count with the first."""
    together: dict[str, Counter[str]] = {}
    for name, counts in used.items():
        together.setdefault(name.split("-")[0], Counter()).update(counts)
    kinds = ("main", "zenoh", "other")
    rows: list[list[object]] = []
    for name, counts in together.items():
        ms = [counts[kind] / TICKS_PER_S / steps * 1e3 for kind in kinds]
        share = sum(counts.values()) / TICKS_PER_S / spent_s
        rows.append([name, *ms, sum(ms), f"{share:.0%}"])
    whole = [sum(float(str(row[i])) for row in rows) for i in range(1, 5)]
    share = sum(sum(c.values()) for c in together.values()) / TICKS_PER_S / spent_s
    rows.append(["all", *whole, f"{share:.0%}"])
    head = ["process", "main thread ms", "Zenoh ms", "other threads ms", "sum ms", "of one core"]
    return f"{table(head, rows)}\n\nA step every {spent_s / steps * 1e3:.2f} ms."


def ticks(supervisor: Supervisor) -> dict[str, Counter[str]]:
    """Processor ticks of every process so far, by kind of thread (Linux)."""
    return {name: of_threads(pid) for name, pid in supervisor.pids().items()}


def of_threads(pid: int) -> Counter[str]:
    """Ticks of a process's threads: main, zenoh, other."""
    found: Counter[str] = Counter()
    for thread in Path(f"/proc/{pid}/task").iterdir():
        kind, used = thread_ticks((thread / "stat").read_text(), is_main=thread.name == str(pid))
        found[kind] += used
    return found


def thread_ticks(stat: str, *, is_main: bool) -> tuple[str, int]:
    """Kind and ticks, in and out of the kernel, from the text of `/proc/PID/task/TID/stat`."""
    name, fields = stat.split("(", 1)[1].rsplit(")", 1)
    user, system = fields.split()[11:13]
    kind = "main" if is_main else "zenoh" if name.startswith(ZENOH) else "other"
    return kind, int(user) + int(system)


if __name__ == "__main__":
    main()
