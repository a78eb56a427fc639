"""P12: how soon an emulated Robotino stands after each fault, and how soon a stop leaves.

The driver of the preset `robotino` runs in a process of its own; a stand-in for the actor keeps the
robot driving. Every fault is to be over within two control periods and the robot's own delay and
ramp; an emergency stop is to reach the robot within 50 ms of the operator's message.

    python -m benchmarks.robot_reaction [--short | --check]
"""

from __future__ import annotations

import signal
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median

from benchmarks.frame import Bar, Mode, mode_of, report, rounds_of, table
from benchmarks.robot_rig import Rig
from services.launcher.up import free_endpoint
from services.robot_driver.emulation.dynamics import ROBOTINO
from services.robot_driver.motion_control import action_velocity
from shared import settings
from shared.config import Config
from shared.messages import RobotState

BATTERY = "battery low, from the message that said so"
FAULTS: dict[str, dict[str, object]] = {
    "camera frozen": {"camera": "frozen"},
    "camera 500": {"camera": "500"},
    "camera truncated": {"camera": "truncated"},
    "camera of one colour": {"camera": "flat"},
    "odometry frozen": {"odometry": "frozen"},
    "bumper unreadable": {"bumper": "unreadable"},
    "network cut": {"network": "cut"},
    "network silent": {"network": "silent"},
    "commands refused": {"commands": "refused"},
    BATTERY: {"battery_low": True},
}
SOUND: dict[str, object] = {
    "camera": "",
    "odometry": "",
    "bumper": "",
    "network": "",
    "commands": "",
    "battery_low": False,
}


def configuration() -> Config:
    """The preset, on loopback."""
    return settings.load(
        "robotino",
        overrides=[
            "run.name=reaction",
            f"bus.endpoint={free_endpoint()}",
            "robot.hardware.open_timeout_s=60",
        ],
    )


def allowed_s(config: Config) -> float:
    """Two control periods, and the robot's own delay and ramp."""
    return 2 * config.robot.period_s + ROBOTINO.stop_time_s(action_velocity(config, 1))


def cases(rig: Rig) -> dict[str, Callable[[], float]]:
    """Return a function for each fault, which returns the time until the robot stood."""

    def fault(changes: dict[str, object]) -> float:
        since_s = rig.faults(**changes)
        if "battery_low" in changes:
            since_s = rig.wait(lambda: rig.truth()["low_told_s"], "the robot says so")
        spent_s = rig.wait_still(since_s)
        rig.faults(**SOUND)
        return spent_s

    def killed(name: str) -> float:
        spent_s = rig.wait_still(rig.kill(name))
        rig.start(name)
        return spent_s

    def frozen(name: str) -> float:
        spent_s = rig.wait_still(rig.signal(name, signal.SIGSTOP))
        rig.signal(name, signal.SIGCONT)
        return spent_s

    return {
        **{name: lambda changes=changes: fault(changes) for name, changes in FAULTS.items()},  # type: ignore[misc]
        "actor killed": lambda: killed("actor"),
        "actor frozen": lambda: frozen("actor"),
        "router killed": lambda: killed("router"),
        "driver killed (the robot's watchdog)": lambda: killed("driver"),
        "driver frozen (the robot's watchdog)": lambda: frozen("driver"),
    }


def emergency_stops(rig: Rig, recovering: bool) -> tuple[float, float]:
    """Seconds from an operator's message to the first zero at the robot, and until it stands."""
    rig.wait_driving()
    if recovering:
        rig.faults(bumper="stuck")
        rig.wait_state(is_recovering, "the robot recovers")
        rig.wait(lambda: rig.truth()["still_since_s"] is None, "it moves back")
    assert rig.bus  # connected: what is measured is the way of a message
    at_s = time.monotonic()
    rig.command("estop")
    zero_s, still_s = rig.first_stop_s(at_s), rig.wait_still(at_s)
    rig.faults(bumper="")
    rig.command("clear")
    return zero_s, still_s


def is_recovering(state: RobotState) -> bool:
    """Whether the robot backs off from a bump."""
    return state.state == "recovering"


def measure(mode: Mode) -> tuple[list[list[object]], list[Bar]]:
    """Rows of reaction times, and the bars P12a and P12b."""
    rounds = 1 if mode == "check" else rounds_of(mode, 3, 10)
    config = configuration()
    limit_s = allowed_s(config)
    rows: list[list[object]] = []
    worst_s, count = 0.0, 0
    zeros: list[float] = []
    with tempfile.TemporaryDirectory() as place, Rig(config, Path(place) / "run") as rig:
        rig.start("router", "driver", "actor")
        for name, case in cases(rig).items():
            if mode == "check" and count >= 3:
                break
            spent = []
            for _ in range(rounds):
                rig.wait_driving()
                spent.append(case())
            rows.append([name, median(spent), max(spent), limit_s])
            worst_s, count = max(worst_s, *spent), count + rounds
        for name, recovering in (("driving", False), ("recovering", True)):
            found = [emergency_stops(rig, recovering) for _ in range(rounds)]
            zeros += [zero_s for zero_s, _ in found]
            still = [still_s for _, still_s in found]
            rows.append([f"emergency stop while {name}", median(still), max(still), limit_s])
    bars = [
        Bar("P12a", worst_s / limit_s, "of allowed", "lower", 1.0, 0.9, limit_s, worst_s, count),
        Bar("P12b", 1e3 * max(zeros), "ms", "lower", 50.0, 30.0, None, 1e3 * median(zeros),
            len(zeros)),
    ]  # fmt: skip
    return rows, bars


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and report."""
    rows, bars = measure(mode_of(arguments, __doc__))
    head = ["fault", "median s until it stands", "longest s", "allowed s"]
    report("Reaction of an emulated Robotino", [table(head, rows)], bars)


if __name__ == "__main__":
    main()
