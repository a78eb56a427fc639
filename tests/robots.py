"""Robots of all kinds under one roof: for tests that every driver must pass."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass

from services.robot_driver.emulation.faults import Faults
from services.robot_driver.emulation.robotino import EmulatedRobotino, RobotinoServer
from services.robot_driver.robot import Pose, Robot
from services.robot_driver.service import make_robot
from shared.config import Config

SPEED_M_S, TURN_RAD_S = 0.2, 0.6


@dataclass
class Subject:
    """A robot ready to drive, and what it really does."""

    config: Config
    robot: Robot
    true_pose: Callable[[], Pose]
    """In the world."""
    stop_s: float
    """Until it stands after it was told to stop, delay and ramp included."""


def real_time(**robot: object) -> Config:
    """Slow motion and patient limits: test machines stall."""
    tree: dict[str, object] = {
        "timing": "realtime",
        "period_s": 1.5,
        "speed_m_s": SPEED_M_S,
        "turn_rad_s": TURN_RAD_S,
        "max_speed_m_s": 0.3,
        "max_turn_rad_s": 1.0,
        "deadman_s": 2.0,
        "hardware": {
            "camera_stale_s": 4.0,
            "odometry_stale_s": 4.0,
            "bumper_stale_s": 4.0,
            "open_timeout_s": 60.0,
        },
        **robot,
    }
    return Config.model_validate({"robot": tree})


@contextmanager
def robotino_server(faults: Faults | None = None) -> Iterator[tuple[EmulatedRobotino, str]]:
    """An emulated Robotino in this process, and its address."""
    emulated = EmulatedRobotino("plus", faults or Faults())
    try:
        with RobotinoServer("127.0.0.1:0", emulated) as server:
            thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
            thread.start()
            try:
                yield emulated, server.address
            finally:
                server.shutdown()
                thread.join()
    finally:
        emulated.robot.close()


@contextmanager
def simulated() -> Iterator[Subject]:
    """The simulation, paced by the wall clock."""
    config = real_time()
    with closing(make_robot(config)) as robot:
        yield Subject(config, robot, lambda: robot.feel().pose, 0.0)


@contextmanager
def robotino() -> Iterator[Subject]:
    """The Robotino's driver in front of its emulator."""
    with robotino_server() as (emulated, address):
        config = real_time(kind="robotino", robotino={"address": address, "timeout_s": 2.0})
        with closing(make_robot(config)) as robot:
            yield Subject(config, robot, lambda: emulated.robot.truth().pose, 1.0)


SUBJECTS: dict[str, Callable[[], AbstractContextManager[Subject]]] = {
    "sim": simulated,
    "robotino": robotino,
}
"""Every driver there is; another one joins by a line here."""
