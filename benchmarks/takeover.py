"""P17: how soon a key of a person who took a robot over moves it.

`corridor takeover` runs in a terminal. The person lets the robot stand, then presses a key; what
counts is the time until velocity reaches the emulated Robotino, or until the driver of a simulated
robot in real time has the action.

    python -m benchmarks.takeover [--short | --check]
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median, quantiles

from benchmarks.frame import Bar, Mode, mode_of, report, rounds_of, table
from benchmarks.robot_reaction import configuration
from benchmarks.robot_rig import PARTS, PATIENCE_S, Rig
from benchmarks.terminals import Terminal
from benchmarks.waiting import wait_until
from services.commander.keyboard import DEADMAN_S
from services.launcher.up import free_endpoint
from shared import settings
from shared.config import Config
from shared.keys import ACTION, ACTOR_STATE
from shared.messages import Action, ActorState, RobotState

COMMAND = Path(sys.executable).with_name("corridor")
KEY, REPEAT_S = b"a", 0.03
"""Forward/left, as a keyboard repeats it."""


def with_person(config: Config) -> Config:
    """The same run, whose small memory a person is to fill."""
    tree = config.to_dict()
    tree["memory"] |= {"fill": "human", "capacity": 3000}
    tree["network"]["filters"] = 16
    return Config.model_validate(tree)


def simulated() -> Config:
    """A simulated robot in real time."""
    chosen = [f"bus.endpoint={free_endpoint()}", "robot.timing=realtime", "run.name=person"]
    return settings.load("demo", overrides=chosen)


class Wheel(Rig):
    """The rig with a real actor, and what it needs."""

    def start_all(self) -> None:
        """Start them."""
        self.start("router", "driver", "replay", "learner")
        options = ("--config", str(self._file), "--run-dir", str(self.folder))
        self._corridor("real actor", "actor", *options)

    def moved_s(self, at_s: float) -> float | None:
        """When velocity first arrived at the emulated Robotino after a time; None: not yet."""
        found = (c["at_s"] for c in self.truth()["commands"] if any(c[part] for part in PARTS))
        return next((s for s in found if s >= at_s), None)


def reactions(config: Config, rounds: int) -> list[float]:
    """Seconds from a key to the robot, many times."""
    with tempfile.TemporaryDirectory() as place, Wheel(config, Path(place) / "run") as rig:
        rig.start_all()
        actions = rig.bus.inbox()
        actions.subscribe(ACTION)
        actions.subscribe(ACTOR_STATE)
        rig.wait(lambda: actions.take(ACTOR_STATE, ActorState), "an actor serves the robot")

        def answered(_at_s: float) -> float | None:
            actions.wait(0.005)
            taken = actions.take(ACTION, Action)
            return time.monotonic() if any(a.action is not None for _, a in taken) else None

        arrived = rig.moved_s if config.robot.kind == "robotino" else answered
        there = ["--endpoint", config.bus.endpoint, "--run", config.run.name]
        with Terminal([str(COMMAND), "takeover", *there]) as person:
            rig.wait(lambda: "stands" in person.shown(), "a person")
            return [reaction(rig, person, arrived, number) for number in range(rounds)]


def reaction(
    rig: Rig, person: Terminal, arrived: Callable[[float], float | None], number: int
) -> float:
    """One key, pressed at any moment of the control period, while the robot stands."""
    rig.wait_state(fit, "it may drive")
    time.sleep(DEADMAN_S + 2 * rig.config.robot.period_s + 0.037 * (number % 10))
    arrived(time.monotonic())
    at_s = time.monotonic()

    def moves() -> float | None:
        person.press(KEY)
        person.shown()
        until_s = time.monotonic() + REPEAT_S
        while (found := arrived(at_s)) is None and time.monotonic() < until_s:
            time.sleep(0.002)
        return found

    return float(wait_until(moves, PATIENCE_S, "it moves")) - at_s  # type: ignore[arg-type]


def fit(state: RobotState) -> bool:
    """Whether the robot would obey an action."""
    return state.state in ("driving", "waiting")


def measure(mode: Mode) -> tuple[list[list[object]], list[Bar]]:
    """Rows of times, and the bars P17a and P17b."""
    rounds = 3 if mode == "check" else rounds_of(mode, 20, 100)
    rows: list[list[object]] = []
    bars = []
    for name, ident, config in (
        ("simulated robot in real time", "P17a", simulated()),
        ("emulated Robotino", "P17b", configuration()),
    ):
        times = [1e3 * s for s in reactions(with_person(config), rounds)]
        p95 = quantiles(times, n=20, method="inclusive")[18]
        rows.append([name, median(times), p95, max(times), len(times)])
        bars.append(
            Bar(ident, p95, "ms p95", "lower", 150.0, 75.0, None, median(times), len(times))
        )
    return rows, bars


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and report."""
    rows, bars = measure(mode_of(arguments, __doc__))
    head = ["robot", "median ms", "p95 ms", "longest ms", "n"]
    report("From a person's key to the robot", [table(head, rows)], bars)


if __name__ == "__main__":
    main()
