"""Simulated time at the pace of the wall clock."""

import time

from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import World
from shared.config import RobotConfig


class PacedRobot(SimRobot):
    """A simulated robot whose time runs like the clock on the wall."""

    def __init__(self, config: RobotConfig, world: World, seed: int) -> None:
        super().__init__(config, world, seed)
        self._due_s = time.monotonic()

    def run(self, duration_s: float, *, stop_on_contact: bool) -> bool:
        """Simulate, then wait until the wall clock has caught up."""
        contact = super().run(duration_s, stop_on_contact=stop_on_contact)
        self._due_s = max(self._due_s, time.monotonic() - duration_s) + duration_s
        time.sleep(max(0.0, self._due_s - time.monotonic()))
        return contact
