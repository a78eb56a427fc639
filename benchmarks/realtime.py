"""P13: real time with learning through the emulated Robotino: missed deadlines, frame to action.

Router and all four services run as `corridor up --preset robotino` starts them, with a smaller
memory so that fitting phases come soon. Times are taken by a client of the router, from the arrival
of an observation to the arrival of the action that answers it.

    python -m benchmarks.realtime [--short | --check]
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from benchmarks.distribution import connected
from benchmarks.frame import Bar, Mode, mode_of, report, table
from services.launcher.supervisor import Supervisor
from services.launcher.up import child_specs, free_endpoint
from shared import settings
from shared.bus import Bus
from shared.config import Config
from shared.keys import ACTION, LEARNER_STATE, OBSERVATION, ROBOT_STATE
from shared.messages import Action, LearnerState, Observation, RobotState
from shared.numerics import settle_all
from shared.provenance import ROOT

LONG = True
PLAIN = [
    f"numerics.{role}.{key}={value}"
    for role in ("actor", "replay", "learner")
    for key, value in (("device", "cpu"), ("engine", "torch"), ("precision", "float32"))
] + [
    "numerics.replay.threads=1",
    "numerics.learner.threads=1",
    "robot.period_s=0.5",
    "robot.deadman_s=1",
    "robot.robotino.timeout_s=2",
    "robot.hardware.camera_stale_s=4",
    "robot.hardware.odometry_stale_s=4",
    "robot.hardware.bumper_stale_s=4",
    "robot.hardware.open_timeout_s=60",
]
"""Where only the running is checked: nothing is measured first, and a busy machine will do."""
EPISODES = {"check": 2, "short": 20, "full": 100}
PATIENCE_S = 3 * 3600.0


class Watch:
    """What a client of the router sees: latencies by what the learner does, newest states."""

    def __init__(self, bus: Bus) -> None:
        self._inbox = bus.inbox()
        for stream in (OBSERVATION, ACTION, ROBOT_STATE, LEARNER_STATE):
            self._inbox.subscribe(stream)
        self.latencies: defaultdict[str, list[float]] = defaultdict(list)
        self.robot: RobotState | None = None
        self.learner: LearnerState | None = None
        self._asked: tuple[tuple[str, int, int], float] | None = None

    def look(self) -> None:
        """Wait for messages and take their times."""
        self._inbox.wait(0.2)
        now_s = time.perf_counter()
        for _, seen in self._inbox.take(OBSERVATION, Observation):
            self._asked = ((seen.life, seen.sequence, seen.attempt), now_s)
        for _, action in self._inbox.take(ACTION, Action):
            place = (action.robot_life, action.sequence, action.attempt)
            if self._asked and self._asked[0] == place and action.action is not None:
                fitting = self.learner is not None and self.learner.activity == "fitting"
                self.latencies["fitting" if fitting else "idle"].append(now_s - self._asked[1])
        for _, state in self._inbox.take(ROBOT_STATE, RobotState):
            self.robot = state
        for _, learner in self._inbox.take(LEARNER_STATE, LearnerState):
            self.learner = learner


@contextmanager
def emulator() -> Iterator[str]:
    """An emulated Robotino in a process of its own; yields its address."""
    command = [sys.executable, "-m", "services.cli", "emulate", "robotino", "--tethered"]
    with subprocess.Popen(
        [*command, "--listen", "127.0.0.1:0"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    ) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        yield process.stdout.readline().strip()
        process.stdin.close()


def configuration(address: str, mode: Mode) -> Config:
    """The preset with a memory that is full within minutes."""
    small = mode == "check"
    return settings.load(
        "robotino",
        overrides=[
            "run.name=realtime",
            f"bus.endpoint={free_endpoint()}",
            f"robot.robotino.address={address}",
            f"memory.capacity={100 if small else 1000}",
            f"network.filters={4 if small else 64}",
            "episode.max_samples=100",
            f"learning.fit_every={1 if small else 10}",
            *(PLAIN if small else ()),
        ],
    )


def drive(config: Config, folder: Path, episodes: int) -> Watch:
    """Let the whole system learn for so many episodes."""
    stored = settings.claim(folder, config)
    settle_all(stored, folder)
    (folder / "logs").mkdir(exist_ok=True)
    specs = child_specs(config, stored, folder, config.bus.endpoint)
    deadline_s = time.monotonic() + PATIENCE_S
    with Supervisor(specs, folder / "logs", dict(os.environ), []), connected(config) as bus:
        watch = Watch(bus)
        while watch.learner is None or watch.learner.episode < episodes:
            watch.look()
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"no {episodes} episodes in {PATIENCE_S:.0f} s: {watch.learner}")
        return watch


def measure(mode: Mode) -> tuple[list[list[object]], list[Bar]]:
    """Rows of latencies, and the bars P13a to P13c."""
    with tempfile.TemporaryDirectory() as place, emulator() as address:
        watch = drive(configuration(address, mode), Path(place) / "run", EPISODES[mode])
    assert watch.robot is not None
    rows: list[list[object]] = []
    p95 = {}
    for name in ("idle", "fitting"):
        times = 1e3 * np.array(watch.latencies[name] or [0.0])
        p95[name] = float(np.percentile(times, 95))
        p50, p99 = (float(np.percentile(times, part)) for part in (50, 99))
        rows.append([f"learner {name}", len(watch.latencies[name]), p50, p95[name], p99])
    actions = watch.robot.sequence
    missed = 100.0 * watch.robot.late_actions / max(actions, 1)
    checks = {"blocks": float(watch.robot.blocks), "bumps": float(watch.robot.bumps)}
    checks |= {f"fault {fault.name}": float(fault.count) for fault in watch.robot.faults}
    counts = {name: len(times) for name, times in watch.latencies.items()}
    bars = [
        Bar("P13a", missed, "% missed", "lower", 1.0, 0.2, None, None, actions, checks),
        Bar("P13b", p95["idle"], "ms", "lower", 60.0, 30.0, None, None, counts.get("idle", 0)),
        Bar("P13c", p95["fitting"], "ms", "lower", 120.0, 60.0, None, None,
            counts.get("fitting", 0)),
    ]  # fmt: skip
    return rows, bars


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and report."""
    rows, bars = measure(mode_of(arguments, __doc__))
    head = ["while", "actions", "median ms", "p95 ms", "p99 ms"]
    report("Real time through the emulated Robotino", [table(head, rows)], bars)


if __name__ == "__main__":
    main()
