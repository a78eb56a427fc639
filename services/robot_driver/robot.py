"""What a driver needs of a robot, real or simulated: the only interface between the two.

Units are SI, angles counter-clockwise, x forward. The driver (`driver.py`) owns safety and time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

from shared.messages import ImageArray

if TYPE_CHECKING:
    from services.robot_driver.simulated.world import World
    from services.robot_driver.simulated.world_parts import Obstacle


@dataclass(frozen=True)
class Pose:
    """Position and heading in the odometry frame."""

    x_m: float
    y_m: float
    heading_rad: float


@dataclass(frozen=True)
class Velocity:
    """Body velocity: forward, left, counter-clockwise."""

    forward_m_s: float
    left_m_s: float
    turn_rad_s: float

    @property
    def moving(self) -> bool:
        """Whether any component is not zero."""
        return bool(self.forward_m_s or self.left_m_s or self.turn_rad_s)


STANDSTILL = Velocity(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Felt:
    """One reading of odometry and bumper."""

    pose: Pose
    contact: bool
    """The ring bumper is pressed now."""


@dataclass(frozen=True)
class Sensed(Felt):
    """One reading of all sensors. image: uint8 [50, 75], preprocessed at the edge (A22)."""

    image: ImageArray


class Laps(NamedTuple):
    """Laps completed: net, anticlockwise (turning left round the island), clockwise."""

    net: int
    left: int
    right: int


class ChangeableWorld(Protocol):
    """A world that can be changed between two actions: a simulated one."""

    @property
    def world(self) -> World:
        """The world the robot drives in now."""

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """The boxes that stand in it now."""

    def place(self, obstacle: Obstacle) -> None:
        """Let a box stand there. Raises ValueError, nothing changed, when that cannot be."""

    def remove(self, name: str) -> None:
        """Take a box away. Raises ValueError when there is none of that name."""

    def switch(self, world: World, start: int = 0) -> None:
        """Stand at a start of another world. Raises ValueError, nothing changed."""


class Base(ABC):
    """What moves and feels: all that a recovery asks of a robot."""

    @abstractmethod
    def feel(self) -> Felt:
        """Read odometry and bumper only: without the cost of a picture. Raises RobotFault."""

    @abstractmethod
    def drive(self, velocity: Velocity) -> None:
        """Set the body velocity that holds until the next call. Raises RobotFault."""

    @abstractmethod
    def run(self, duration_s: float, *, stop_on_contact: bool) -> bool:
        """Let `duration_s` pass, with `stop_on_contact` standing from the first contact on, if any.

        Returns whether there was contact at any time.
        """


class Robot(Base):
    """A mobile base with one camera and a ring bumper: everything a driver asks of it."""

    @abstractmethod
    def sense(self) -> Sensed:
        """Read camera, odometry and bumper now. Raises RobotFault when a sensor cannot be read."""

    @abstractmethod
    def now_s(self) -> float:
        """Simulated time, or the monotonic clock."""

    @abstractmethod
    def state(self) -> dict[str, float | int | str]:
        """Everything a later process needs to continue exactly here (empty on hardware)."""

    @abstractmethod
    def restore(self, state: dict[str, float | int | str]) -> None:
        """Continue from `state()`. Raises ValueError when it does not fit this robot."""

    @abstractmethod
    def close(self) -> None:
        """Stand still and let go of the robot. May be called twice."""

    @property
    def laps(self) -> Laps:
        """Laps so far, for reports only."""
        return Laps(0, 0, 0)

    @property
    def faults(self) -> Counter[str]:
        """How often each fault occurred between the driver and its robot."""
        return Counter()

    @property
    def changeable(self) -> ChangeableWorld | None:
        """The robot's world, if it can be changed."""
        return None


class RobotFault(Exception):
    """The robot cannot be read or commanded: stand still, report, let the service end."""


class NotReady(RobotFault):
    """The robot must stand still for now, the text says why: a sensor is stale, its battery low."""

    def __init__(self, reason: str, *, contact: bool = False) -> None:
        super().__init__(reason)
        self.contact = contact
        """Whether it also hit something as it became so."""
