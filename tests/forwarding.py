"""A robot for tests that passes everything on to another."""

from __future__ import annotations

from collections import Counter

from services.robot_driver.robot import ChangeableWorld, Felt, Laps, Robot, Sensed, Velocity


class ForwardingRobot(Robot):
    """A robot that passes everything on to another; subclasses replace what they do otherwise."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot

    def sense(self) -> Sensed:
        """Read the other robot's sensors."""
        return self._robot.sense()

    def feel(self) -> Felt:
        """Read the other robot's odometry and bumper."""
        return self._robot.feel()

    def drive(self, velocity: Velocity) -> None:
        """Set the other robot's velocity."""
        self._robot.drive(velocity)

    def run(self, duration_s: float, *, stop_on_contact: bool) -> bool:
        """Let time pass for the other robot."""
        return self._robot.run(duration_s, stop_on_contact=stop_on_contact)

    def now_s(self) -> float:
        """The other robot's clock."""
        return self._robot.now_s()

    def state(self) -> dict[str, float | int | str]:
        """The other robot's state."""
        return self._robot.state()

    def restore(self, state: dict[str, float | int | str]) -> None:
        """Restore the other robot."""
        self._robot.restore(state)

    def close(self) -> None:
        """Close the other robot."""
        self._robot.close()

    @property
    def laps(self) -> Laps:
        """The other robot's laps."""
        return self._robot.laps

    @property
    def faults(self) -> Counter[str]:
        """The other robot's faults."""
        return self._robot.faults

    @property
    def changeable(self) -> ChangeableWorld | None:
        """The other robot's world, if it can be changed."""
        return self._robot.changeable
