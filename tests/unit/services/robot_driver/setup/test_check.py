"""`corridor robot check` lists every sensor and says what keeps the robot from driving."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from fake_link import FakeLink, config_of

from services.robot_driver.real.link import Battery
from services.robot_driver.robot import Pose, RobotFault
from services.robot_driver.setup.check import check
from shared.errors import RobotMissing

ROBOT = config_of(period_s=0.2, deadman_s=0.3, hardware={"camera_stale_s": 0.6}).robot
Change = Callable[["StillLink"], None]


class StillLink(FakeLink):
    """A link whose readings come in simulated time, each time that the caller waits."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s, self.voltage_v = 100.0, 19.0
        self.every = dict.fromkeys(("camera", "odometry", "bumper"), 0.1)
        self.next = dict.fromkeys(self.every, 0.0)
        self.late_s = 0.02

    def open(self) -> None:
        if self.refuses:
            raise RobotFault("robot.ros2.endpoint: no router")

    def wait(self, duration_s: float) -> None:
        self.now_s += duration_s
        values = {
            "camera": np.full((50, 75), 7, np.uint8),
            "odometry": Pose(1.0, 2.0, 0.5),
            "bumper": self.pressed,
        }
        for name, period_s in self.every.items():
            if self.now_s >= self.next[name]:
                self.next[name] = self.now_s + period_s
                getattr(self, name).put(values[name], self.now_s - self.late_s, "320x240 jpeg")
        self.battery.put(Battery(self.low, self.voltage_v), self.now_s)


def looked(link: StillLink) -> tuple[list[str], str]:
    lines: list[str] = []
    problems = check(ROBOT, link, 3.0, lines.append, lambda: link.now_s, link.wait)
    assert link.closed == 1
    assert link.told == []
    return problems, "\n".join(lines)


def test_a_sound_robot_is_ready_and_every_sensor_is_listed() -> None:
    problems, text = looked(StillLink())
    assert problems == []
    camera = next(line for line in text.splitlines() if line.startswith("camera"))
    assert camera.split()[2] == "20"
    assert "grey values 7 to 7, 320x240 jpeg" in camera
    assert "x 1.000 m, y 2.000 m" in text
    assert "good, 19.0 V" in text


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda link: link.every.pop("bumper"), "bumper: no reading"),
        (lambda link: link.every.update(camera=0.5), "camera: 2.0 readings a second, expected 5"),
        (lambda link: setattr(link, "late_s", 0.8), "camera: nothing new for 0."),
        (lambda link: setattr(link, "pressed", True), "bumper: pressed"),
        (lambda link: setattr(link, "low", True), "battery: low"),
        (lambda link: setattr(link, "hindrance", "robot listens for Twist"), "robot listens for"),
    ],
)
def test_what_is_wrong_is_named(change: Change, problem: str) -> None:
    link = StillLink()
    change(link)
    problems, text = looked(link)
    assert any(each.startswith(problem) for each in problems), problems
    assert f"! {problem}" in text


def test_why_a_sensor_is_silent_is_told() -> None:
    link = StillLink()
    link.every.pop("bumper")
    link.bumper.note = "press it once"
    assert looked(link)[0] == ["bumper: no reading: press it once"]


def test_a_robot_that_cannot_be_reached_is_missing() -> None:
    link = StillLink()
    link.refuses = True
    with pytest.raises(RobotMissing, match="no router"):
        looked(link)
