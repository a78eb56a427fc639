"""P6: the simulator: frames a second of the camera path, milliseconds of physics an action.

The camera path is rendering and preprocessing to 50x75, on one core, along a random drive in Plus;
physics is motion and contact of one action. Camera sizes take turns.

    python -m benchmarks.simulator [--short | --check]
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from statistics import median

import numpy as np

from benchmarks.frame import Bar, Mode, mode_of, report, table
from services.robot_driver.motion_control import action_velocity
from services.robot_driver.robot import Velocity
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import load_world
from shared.config import Config, RobotConfig
from shared.facts import ACTION_COUNT, IMAGE_HEIGHT, IMAGE_WIDTH

SIZES = ((IMAGE_WIDTH, IMAGE_HEIGHT), (2 * IMAGE_WIDTH, 2 * IMAGE_HEIGHT))
"""Width and height rendered; the first is the configured default."""


def robot_of(width: int, height: int) -> SimRobot:
    """A robot in Plus that renders at this size."""
    robot = RobotConfig.model_validate(
        {"camera": {"render_width_px": width, "render_height_px": height}}
    )
    return SimRobot(robot, load_world(robot.world), 0)


def drive(robots: Sequence[SimRobot], actions: int) -> tuple[list[list[float]], list[float]]:
    """Seconds of each robot's camera path and of physics, over the same random drive."""
    config, draw = Config(), np.random.default_rng(0)
    seen: list[list[float]] = [[] for _ in robots]
    moved: list[float] = []
    for action in draw.integers(0, ACTION_COUNT, actions):
        velocity = action_velocity(config, int(action))
        for robot, spent in zip(robots, seen, strict=True):
            robot.drive(velocity)
            start_s = time.perf_counter()
            bump = robot.run(config.robot.period_s, stop_on_contact=True)
            driven_s = time.perf_counter()
            robot.sense()
            spent.append(time.perf_counter() - driven_s)
            moved.append(driven_s - start_s)
            if bump:
                turn_away(robot)
    return seen, moved


def turn_away(robot: SimRobot) -> None:
    """Leave the wall the same way every time, so that all robots stay on one route."""
    config = robot.config
    robot.drive(Velocity(-config.recovery_speed_m_s, 0.0, 0.0))
    robot.run(config.recovery_distance_m / config.recovery_speed_m_s, stop_on_contact=False)
    robot.drive(Velocity(0.0, 0.0, config.turn_rad_s))
    robot.run(2.0, stop_on_contact=False)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and report."""
    mode: Mode = mode_of(arguments, __doc__)
    actions = {"check": 20, "short": 1000, "full": 5000}[mode]
    robots = [robot_of(*size) for size in SIZES]
    seen, moved = drive(robots, actions)
    rows: list[list[object]] = [
        [f"camera path at {w}x{h}", median(spent) * 1e3, 1.0 / median(spent)]
        for (w, h), spent in zip(SIZES, seen, strict=True)
    ]
    rows.append(["physics and contact, one action", median(moved) * 1e3, 1.0 / median(moved)])
    frames, physics = 1.0 / median(seen[0]), median(moved) * 1e3
    bars = [
        Bar("P6a", frames, "frames/s", "higher", 120, 400, 1.0 / median(seen[1]), frames, actions),
        Bar("P6b", physics, "ms", "lower", 0.5, 0.5, None, physics, len(moved)),
    ]
    for robot in robots:
        robot.close()
    report("Simulator", [table(["what", "median ms", "per second"], rows)], bars)


if __name__ == "__main__":
    main()
