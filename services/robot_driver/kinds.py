"""The kinds of robots there are, and how one of them is made ready to drive."""

import logging
from typing import NamedTuple

from services.extras import import_installed
from services.robot_driver.real.link import Link
from services.robot_driver.robot import Robot, RobotFault
from shared import plugins
from shared.config import Config
from shared.errors import ConfigError, RobotMissing

log = logging.getLogger(__name__)


class Kind(NamedTuple):
    """A kind of real robot: how it is reached, and what must be installed for it."""

    module: str
    """The module with its link, in `services.robot_driver.real`."""
    link: str
    """The class in it, a `real.link.Link`."""
    extra: str
    """The extra of this package that its libraries come with."""


REAL = {
    "robotino": Kind("robotino", "RobotinoLink", "robotino"),
    "ros2": Kind("ros2", "Ros2Link", "ros2"),
}
"""Real robots by `robot.kind`. Other packages may add to them."""


def make_robot(config: Config) -> Robot:
    """The robot of this configuration, ready to drive. Raises ConfigError or RobotMissing."""
    return _simulated(config) if config.robot.kind == "sim" else _real(config)


def make_link(config: Config) -> Link:
    """The way to a real robot, not opened yet. Raises ConfigError."""
    if config.robot.kind == "sim":
        raise ConfigError(f"robot.kind: expected a real robot ({', '.join(REAL)}), got 'sim'")
    kind, link = REAL.get(config.robot.kind), None
    if kind is None:
        link = plugins.load(plugins.ROBOTS, config.robot.kind)
    else:
        module = import_installed(f"services.robot_driver.real.{kind.module}", kind.extra)
        link = getattr(module, kind.link)
    made: Link = link(config)
    return made


def _real(config: Config) -> Robot:
    from services.robot_driver.real.hardware import HardwareRobot

    for name in ("camera_stale_s", "odometry_stale_s", "bumper_stale_s"):
        if getattr(config.robot.hardware, name) > 2.0 * config.robot.period_s:
            log.warning(
                "robot.hardware.%s is longer than two robot.period_s: the robot stops later "
                "than it could",
                name,
            )
    try:
        return HardwareRobot(config.robot, make_link(config))
    except RobotFault as error:
        raise RobotMissing(f"driver: {error}") from error


def _simulated(config: Config) -> Robot:
    import_installed("services.robot_driver.simulated.paced", "sim")
    from services.robot_driver.simulated.paced import PacedRobot
    from services.robot_driver.simulated.sim import SimRobot
    from services.robot_driver.simulated.world import load_world

    make = PacedRobot if config.robot.timing == "realtime" else SimRobot
    try:
        return make(config.robot, load_world(config.robot.world), config.run.seed)
    except (ConfigError, ValueError) as error:
        raise ConfigError(f"robot.world: {error}") from error
