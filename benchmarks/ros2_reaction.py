"""P12c: how soon emulated ROS 2 robots stand after each fault.

The drivers of the presets `robotino-ros2` (through zenoh-bridge-ros2dds) and `turtlebot4` (through
rmw_zenoh) run in processes of their own; a stand-in for the actor keeps the robots driving. Every
fault is to be over within two control periods and the base's own delay and ramp; where nothing
reaches the base any more, its own watchdog takes the place of the two periods.

    python -m benchmarks.ros2_reaction [--short | --check]
"""

from __future__ import annotations

import signal
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median

from benchmarks.frame import Bar, Mode, mode_of, report, rounds_of, table
from benchmarks.robot_reaction import BATTERY
from benchmarks.ros2_rig import Ros2Rig
from services.launcher.up import free_endpoint
from services.robot_driver.emulation.dynamics import CREATE3, ROBOTINO, STEP_S
from services.robot_driver.motion_control import action_velocity
from shared import settings
from shared.config import Config

ROBOTS = (("robotino-ros2", "bridge"), ("turtlebot4", "rmw-zenoh"))
FAULTS: dict[str, dict[str, object]] = {
    "another type of velocity": {"wrong_type": True},
    "nobody listens": {"nobody_listens": True},
    "odometry frozen": {"odometry": "frozen"},
    "camera frozen": {"camera": "frozen"},
    "camera frozen, stamps go on": {"camera": "restamped"},
    "bumper muted": {"bumper": "muted"},
    "pictures 30 s old": {"camera_late_s": 30.0},
    "truncated CDR": {"payload": "truncated"},
    BATTERY: {"battery_low": True},
}
SOUND: dict[str, object] = {
    "wrong_type": False,
    "nobody_listens": False,
    "odometry": "",
    "camera": "",
    "bumper": "",
    "camera_late_s": 0.0,
    "payload": "",
    "battery_low": False,
}
CLOSED, FROZEN = "session closed", "driver frozen"
UNREACHED = {CLOSED, FROZEN, "another type of velocity", "nobody listens"}
"""Nothing that the driver sends gets to the base any more: its own watchdog stops it."""


def configuration(preset: str, transport: str) -> Config:
    """A preset, on loopback."""
    return settings.load(
        preset,
        overrides=[
            f"run.name=reaction-{preset}",
            f"bus.endpoint={free_endpoint()}",
            f"robot.ros2.transport={transport}",
            "robot.hardware.open_timeout_s=60",
        ],
    )


def allowed_s(config: Config, name: str) -> float:
    """Two control periods, or the base's watchdog, and the base's own delay and ramp."""
    robot = config.robot
    base = CREATE3 if robot.ros2.bumper_type == "HazardDetectionVector" else ROBOTINO
    waits_s = max(2 * robot.period_s, CREATE3.watchdog_s if name in UNREACHED else 0.0)
    return waits_s + base.stop_time_s(action_velocity(config, 1))


def cases(rig: Ros2Rig) -> dict[str, Callable[[], float]]:
    """Return a function for each fault, which returns the time until the robot stood."""

    def fault(changes: dict[str, object]) -> float:
        since_s = rig.faults(**changes)
        if "battery_low" in changes:
            since_s = rig.wait(lambda: rig.truth()["low_told_s"], "the robot says so")
        spent_s = rig.wait_still(since_s)
        rig.faults(**SOUND)
        return spent_s

    def closed() -> float:
        return rig.wait_still(rig.faults(closed_s=3.0) + 2 * STEP_S)  # it answers, then leaves

    def frozen(name: str) -> float:
        spent_s = rig.wait_still(rig.signal(name, signal.SIGSTOP))
        rig.signal(name, signal.SIGCONT)
        return spent_s

    return {
        **{name: lambda changes=changes: fault(changes) for name, changes in FAULTS.items()},  # type: ignore[misc]
        "actor frozen": lambda: frozen("actor"),
        FROZEN: lambda: frozen("driver"),
        CLOSED: closed,
    }


def measure(mode: Mode) -> tuple[list[list[object]], list[Bar]]:
    """Rows of reaction times, and the bar P12c."""
    rounds = 1 if mode == "check" else rounds_of(mode, 3, 10)
    rows: list[list[object]] = []
    parts: list[float] = []
    for preset, transport in ROBOTS[:1] if mode == "check" else ROBOTS:
        config = configuration(preset, transport)
        with tempfile.TemporaryDirectory() as place, Ros2Rig(config, Path(place) / "run") as rig:
            rig.start("router", "driver", "actor")
            for name, case in list(cases(rig).items())[: 3 if mode == "check" else None]:
                spent = []
                for _ in range(rounds):
                    rig.wait_driving()
                    spent.append(case())
                limit_s = allowed_s(config, name)
                rows.append([f"{preset}: {name}", median(spent), max(spent), limit_s])
                parts += [one / limit_s for one in spent]
    bar = Bar("P12c", max(parts), "of allowed", "lower", 1.0, 0.9, None, median(parts), len(parts))
    return rows, [bar]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and report."""
    rows, bars = measure(mode_of(arguments, __doc__))
    head = ["fault", "median s until it stands", "longest s", "allowed s"]
    report("Reaction of emulated ROS 2 robots", [table(head, rows)], bars)


if __name__ == "__main__":
    main()
