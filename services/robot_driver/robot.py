"""What a driver needs of a robot, real or simulated: the only interface between the two.

Units are SI, angles counter-clockwise, x forward. The driver (`driver.py`) owns safety and time;
a robot only senses and moves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from shared.messages import ImageArray


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


class Robot(Protocol):
    """A mobile base with one camera and a ring bumper."""

    def sense(self) -> Sensed:
        """Read camera, odometry and bumper now. Raises RobotFault when a sensor cannot be read."""

    def feel(self) -> Felt:
        """Read odometry and bumper only: without the cost of a picture. Raises RobotFault."""

    def drive(self, velocity: Velocity) -> None:
        """Set the body velocity that holds until the next call. Raises RobotFault."""

    def run(self, duration_s: float, *, stop_on_contact: bool) -> bool:
        """Let `duration_s` pass: simulated, or real while the bumper is watched.

        Returns whether there was contact at any time. With `stop_on_contact` the velocity becomes
        zero at the first contact and the rest of the time passes standing still.
        """

    def now_s(self) -> float:
        """Simulated time, or the monotonic clock."""

    def state(self) -> dict[str, float | int | str]:
        """Everything a later process needs to continue exactly here (empty on hardware)."""

    def restore(self, state: dict[str, float | int | str]) -> None:
        """Continue from `state()`. Raises ValueError when it does not fit this robot."""

    def close(self) -> None:
        """Stand still and let go of the robot. May be called twice."""


class RobotFault(Exception):
    """The robot cannot be read or commanded: stand still, report, let the service end."""


class NotReady(RobotFault):
    """The robot must stand still for now: a sensor is stale, its battery low, its bumper stuck.

    The text says why. Once that is over the robot can go on.
    """

    def __init__(self, reason: str, *, contact: bool = False) -> None:
        super().__init__(reason)
        self.contact = contact
        """Whether it also hit something as it became so."""
