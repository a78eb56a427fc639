"""P5: what distribution costs: steps per second of the lock-step system over one process.

Same robot, same full network, training off: the memory is so large that it is being filled all the
time, so that every step renders, predicts and drives, and every episode is handed over and stored.
The single-process loop and the system take turns.

    python -m benchmarks.distribution [--short | --check]
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from statistics import median

from benchmarks.frame import Bar, Mode, mode_of, report, rounds_of, table
from experiments.single_process import SingleProcess
from services.launcher.supervisor import ChildSpec, Supervisor
from services.launcher.up import child_specs, free_endpoint
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import load_world
from services.security import router_file
from services.security.authority import Authority
from services.security.kinds import Credential
from services.security.use import using
from shared import settings
from shared.bus import Bus
from shared.config import ActorNumerics, Config, Numerics
from shared.errors import RouterMissing
from shared.inbox import Inbox
from shared.keys import OBSERVATION
from shared.messages import Observation
from shared.numerics import choose

DRIVER = ("driver", "robotino1")
WARM_UP_STEPS = 100
PATIENCE_S = 600.0
POLL_S = 0.1


def configuration(filters: int = 64) -> Config:
    """Filling for ever; the actor's arithmetic is what the demo would choose on this machine."""
    base = Config.model_validate(
        {
            "run": {"name": "bench"},
            "memory": {"capacity": 1_000_000},
            "network": {"filters": filters},
        }
    )
    chosen = choose(base, ActorNumerics(engine="auto", precision="auto"), "actor")
    numerics = base.numerics.model_copy(update={"actor": chosen, "replay": Numerics(batch=1)})
    return base.model_copy(update={"numerics": numerics})


def single_process_rate(config: Config, steps: int) -> float:
    """Steps per second of the single-process loop."""
    robot = SimRobot(config.robot, load_world(config.robot.world), config.run.seed)
    loop = SingleProcess(config, robot)
    turns = loop.run()
    while loop.actor.actions < WARM_UP_STEPS:
        next(turns)
    start_s, before = time.perf_counter(), loop.actor.actions
    while loop.actor.actions - before < steps:
        next(turns)
    rate = (loop.actor.actions - before) / (time.perf_counter() - start_s)
    robot.close()
    return rate


def system_rate(config: Config, steps: int, robots: int) -> float:
    """Steps per second of router, four services and further drivers, all robots together."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "run"
        endpoint = free_endpoint()
        bus = config.bus.model_copy(update={"endpoint": endpoint})
        config = config.model_copy(update={"bus": bus})
        stored = settings.claim(folder, config)
        specs = child_specs(config, stored, folder, endpoint)
        specs += [more_robots(specs, f"robotino{i}") for i in range(2, robots + 1)]
        (folder / "logs").mkdir(exist_ok=True)
        with Supervisor(specs, folder / "logs", dict(os.environ), []), connected(config) as client:
            counted = Steps(client.inbox())
            counted.reach(WARM_UP_STEPS, robots)
            start_s, before = time.perf_counter(), counted.look()
            counted.reach_in_all(before + steps)
            return (counted.look() - before) / (time.perf_counter() - start_s)


def encrypted_rate(config: Config, steps: int) -> float:
    """The same with one robot, behind a router that lets in certificates only."""
    with tempfile.TemporaryDirectory() as place:
        authority, until = Authority.create(Path(place)), datetime.now(UTC) + timedelta(days=1)
        authority.certify_router([], until)
        for kind, *robots in (("replay",), ("learner",), ("actor",), ("operator",), DRIVER):
            authority.add(Credential(kind, tuple(robots)), until)
        router_file.write(authority)
        bus = config.bus.model_copy(update={"credentials": place})
        return system_rate(config.model_copy(update={"bus": bus}), steps, 1)


def more_robots(specs: list[ChildSpec], robot: str) -> ChildSpec:
    """A further simulated robot of the same run."""
    driver = next(spec for spec in specs if spec.name == "driver")
    command = (*driver.command, f"--set=robot.id={robot}")
    return ChildSpec(f"driver-{robot}", command, driver.stage)


def connected(config: Config) -> Bus:
    """A client of the run's router, as soon as it answers."""
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            return Bus(using(config, "operator").bus, config.run.name)
        except RouterMissing:
            if time.monotonic() > deadline_s:
                raise


class Steps:
    """Executed actions of all robots, from the numbers of their observations."""

    def __init__(self, inbox: Inbox) -> None:
        self._inbox, self._newest = inbox, dict[str, int]()
        self._deadline_s = time.monotonic() + PATIENCE_S
        inbox.subscribe(OBSERVATION)

    def look(self) -> int:
        """Actions of all robots so far."""
        for robot, seen in self._inbox.take(OBSERVATION, Observation):
            self._newest[robot] = seen.sequence
        return sum(self._newest.values())

    def reach(self, each: int, robots: int) -> None:
        """Return when every one of so many robots has executed `each` actions."""
        self._poll(lambda: len(self._newest) == robots and min(self._newest.values()) >= each)

    def reach_in_all(self, count: int) -> None:
        """Return when all robots together have executed `count` actions."""
        self._poll(lambda: sum(self._newest.values()) >= count)

    def _poll(self, done: Callable[[], bool]) -> None:
        """Look a few times a second: who watches every step takes time from those who make it."""
        while not done():
            if time.monotonic() > self._deadline_s:
                raise TimeoutError(f"no more than {self._newest} steps in {PATIENCE_S:.0f} s")
            time.sleep(POLL_S)
            self.look()


def measure(mode: Mode) -> tuple[list[list[object]], list[Bar]]:
    """Rates of all cases in turns: rows for the table, and the bars P5a to P5c."""
    steps = {"check": 50, "short": 2000, "full": 5000}[mode]
    config = configuration(filters=4 if mode == "check" else 64)
    robots = 2 if mode == "check" else 4
    cases = ("one process", "system, 1 robot", "system, encrypted", "system, n")
    rates: dict[str, list[float]] = {name: [] for name in cases}
    rounds = rounds_of(mode, 2, 3) if mode != "check" else 1
    for _ in range(rounds):
        rates["one process"].append(single_process_rate(config, steps))
        rates["system, 1 robot"].append(system_rate(config, steps, 1))
        rates["system, encrypted"].append(encrypted_rate(config, steps))
        rates["system, n"].append(system_rate(config, steps, robots))
    single, one, guarded, many = (median(rates[name]) for name in cases)
    bars = [
        Bar("P5a", one / single, "x", "higher", 0.6, 0.85, single, one, rounds),
        Bar("P5c", guarded / one, "x", "higher", 0.9, 1.0, one, guarded, rounds),
        Bar("P5b", many / single, "x", "higher", 1.3, 1.8, single, many, rounds),
    ]
    named: list[tuple[str, float]] = [*zip(cases[:3], (single, one, guarded), strict=True)]
    named.append((f"system, {robots} robots", many))
    return [[name, rate, 1e3 / rate] for name, rate in named], bars


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and report."""
    rows, bars = measure(mode_of(arguments, __doc__))
    report("Price of distribution", [table(["case", "steps/s", "ms a step"], rows)], bars)


if __name__ == "__main__":
    main()
