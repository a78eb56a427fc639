"""A link to a robot that is not there: readings stay fresh, commands are kept."""

from __future__ import annotations

import math
import threading
import time
from typing import Any

import numpy as np

from services.robot_driver.real.link import Battery, Slots
from services.robot_driver.real.odometry import joined
from services.robot_driver.robot import STANDSTILL, Pose, RobotFault, Velocity
from shared.config import Config


class FakeLink(Slots):
    """Readings that stay fresh by themselves until they are held; commands are kept."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[Velocity] = []
        self.held: set[str] = set()
        self.pressed = self.low = self.refuses = self.stalled = False
        self.hindrance = ""
        self.closed = 0
        self.pose = Pose(1.0, 2.0, 0.5)
        """Where it is, as its odometry tells; it follows at once what it was told."""
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._refresh, daemon=True)

    def open(self) -> None:
        self._thread.start()

    def obstacle(self) -> str:
        return self.hindrance

    def send(self, velocity: Velocity) -> None:
        if self.refuses:
            raise RobotFault("command: status 503")
        self.told.append(velocity)

    def close(self) -> None:
        self.closed += 1
        self._done.set()

    def _refresh(self) -> None:
        then_s = time.monotonic()
        while not self._done.wait(0.005):
            now_s = time.monotonic()
            self._move(now_s - then_s)
            then_s = now_s
            if "camera" not in self.held:
                self.camera.put(np.full((50, 75), 7, np.uint8), now_s)
            if "odometry" not in self.held:
                self.odometry.put(self.pose, now_s)
            if "bumper" not in self.held:
                self.bumper.put(self.pressed, now_s)
            self.battery.put(Battery(self.low, None), now_s)

    def _move(self, duration_s: float) -> None:
        if self.told and not self.stalled:
            way_m, turn_rad = (
                part * duration_s for part in (self.told[-1].forward_m_s, self.told[-1].turn_rad_s)
            )
            self.pose = joined(self.pose, Pose(way_m, 0.0, turn_rad))


def config_of(**robot: Any) -> Config:
    tree = {
        "kind": "robotino",
        "timing": "realtime",
        "period_s": 2.0,
        "deadman_s": 3.0,
        "hardware": {
            "command_period_s": 0.02,
            "camera_stale_s": 0.5,
            "odometry_stale_s": 0.5,
            "bumper_stale_s": 0.5,
        },
        **robot,
    }
    return Config.model_validate({"robot": tree})


class Plane:
    """A body without walls."""

    def __init__(self) -> None:
        self.pose = Pose(1.0, 2.0, math.pi / 2.0)
        self.contact = False
        self.velocity = STANDSTILL

    def drive(self, velocity: Velocity) -> None:
        self.velocity = velocity

    def run(self, duration_s: float, *, stop_on_contact: bool) -> bool:
        h, v = self.pose.heading_rad, self.velocity
        forward, left = v.forward_m_s * duration_s, v.left_m_s * duration_s
        self.pose = Pose(
            self.pose.x_m + forward * math.cos(h) - left * math.sin(h),
            self.pose.y_m + forward * math.sin(h) + left * math.cos(h),
            h + v.turn_rad_s * duration_s,
        )
        return False
