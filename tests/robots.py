"""Robots of all kinds under one roof: for tests that every driver must pass."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import dataclass

from benchmarks.waiting import wait_until
from services.robot_driver.emulation.robotino import EmulatedRobotino, Faults, RobotinoServer
from services.robot_driver.emulation.ros2 import EmulatedRos2
from services.robot_driver.emulation.ros2_faults import Ros2Faults
from services.robot_driver.kinds import make_robot
from services.robot_driver.robot import NotReady, Pose, Robot
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
            wait_until(lambda: fit(robot), 60, "the robot can be commanded")
            yield Subject(config, robot, lambda: emulated.robot.truth().pose, 1.0)


BRIDGE: dict[str, object] = {"transport": "bridge", "battery_topic": "battery_state"}
"""A base like rto_node's behind zenoh-bridge-ros2dds."""
RMW_ZENOH: dict[str, object] = {
    "transport": "rmw-zenoh",
    "namespace": "bot1",
    "camera_topic": "oakd/rgb/preview/image_raw/compressed",
    "camera_type": "CompressedImage",
    "bumper_topic": "hazard_detection",
    "bumper_type": "HazardDetectionVector",
    "bumper_on_change": False,
}
"""A Create 3 whose nodes are on Zenoh themselves."""


@contextmanager
def ros2_emulator(faults: Ros2Faults | None = None, **ros2: object) -> Iterator[EmulatedRos2]:
    """An emulated ROS 2 robot in this process."""
    config = real_time(kind="ros2", ros2=ros2)
    sound = Ros2Faults(watchdog_s=5.0)  # test machines stall longer than robots wait
    listen = "tcp/127.0.0.1:0"
    with closing(EmulatedRos2(config.robot, "plus", listen, faults or sound)) as emulated:
        yield emulated


def ros2(velocity_type: str, **ros2: object) -> Callable[[], AbstractContextManager[Subject]]:
    """The ROS 2 driver in front of its emulator, which listens for one type of velocity."""

    @contextmanager
    def subject() -> Iterator[Subject]:
        with ros2_emulator(**ros2, velocity_type=velocity_type) as emulated:
            config = real_time(kind="ros2", ros2={**ros2, "endpoint": emulated.endpoint})
            with closing(make_robot(config)) as robot:
                if config.robot.ros2.bumper_on_change:
                    press(emulated, robot)
                wait_until(lambda: fit(robot), 60, "the robot can be commanded")
                yield Subject(config, robot, lambda: emulated.robot.truth().pose, 1.0)

    return subject


def fit(robot: Robot) -> bool:
    """Whether a real robot is ready to drive."""
    try:
        robot.feel()
    except NotReady:
        return False
    return True


def press(emulated: EmulatedRos2, robot: Robot) -> None:
    """Press and release the bumper until it was felt, as its operator does at the start."""

    def told(pressed: bool) -> bool:
        emulated.change({"bumper": "stuck" if pressed else ""})
        with suppress(AssertionError):  # one message may be lost, and there is no other
            wait_until(lambda: fit(robot) and robot.feel().contact == pressed, 3, "it was felt")
        return fit(robot) and robot.feel().contact == pressed

    wait_until(lambda: told(True) and told(False), 60, "the bumper is felt")


SUBJECTS: dict[str, Callable[[], AbstractContextManager[Subject]]] = {
    "sim": simulated,
    "robotino": robotino,
    "ros2-bridge": ros2("Twist", **BRIDGE),
    "ros2-rmw-zenoh": ros2("TwistStamped", **RMW_ZENOH),
}
"""Every driver there is; another one joins by a line here."""
