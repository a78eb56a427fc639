"""Whatever sensors do in whatever order, no robot is told to move without the readings it needs.

Seeded sequences of faults in simulated time, through the links' own reading and judging.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import simplejpeg
from fake_link import config_of

from services.robot_driver.real import cdr, hardware, ros2_names
from services.robot_driver.real.hardware import HardwareRobot
from services.robot_driver.real.link import Battery
from services.robot_driver.real.odometry import joined
from services.robot_driver.real.robotino import RobotinoLink
from services.robot_driver.real.ros2_names import Attachment
from services.robot_driver.real.ros2_sensors import Ros2Sensors
from services.robot_driver.robot import STANDSTILL, NotReady, Pose, Velocity
from shared.foreign_bus import RawSample

TICK_S, SOUND_S, LONG_S, WAY_S = 0.02, 1.0, 6.0, 0.01
PERIODS_S = {"odometry": 0.06, "bumper": 0.06, "camera": 0.1, "battery": 0.5}
STALE_S = {"odometry": 0.3, "bumper": 0.3, "camera": 0.4}
SLACK_S = 2 * TICK_S + WAY_S
ROBOT_S = 1.7e9
"""The robot's clock when ours is 0."""
AHEAD, LEFT, BACK = Velocity(0.2, 0.0, 0.0), Velocity(0.2, 0.0, 0.5), Velocity(-0.1, 0.0, 0.0)
NO_READING = ("silent", "frozen", "unreadable")
FAULTS = (*NO_READING, "late", "copies", "pressed", "low", "set-back", "same-picture")


class _NoThread:
    """The test lets time pass; no thread does."""

    def __init__(self, **_: object) -> None:
        pass

    start = join = lambda self, *_: None


class _Sending:
    """What both links under test share: commands are kept, nothing is connected."""

    told: list[Velocity]

    def open(self) -> None:
        self.told = []

    def obstacle(self) -> str:
        return ""

    def send(self, velocity: Velocity) -> None:
        self.told.append(velocity)

    def close(self) -> None:
        pass


class Ros2(_Sending, Ros2Sensors):
    pass


class Robotino(_Sending, RobotinoLink):
    pass


@dataclass
class Play:
    """One sequence: what is wrong now, and what an honest witness knows of every sensor."""

    kind: str
    dice: random.Random
    link: Any
    now_s: float = 0.0
    pose: Pose = field(default_factory=lambda: Pose(0.0, 0.0, 0.0))
    wrong: dict[str, tuple[str, float]] = field(default_factory=dict)
    """By sensor its fault, and when that is over."""
    clock_s: float = ROBOT_S
    made_s: dict[str, float] = field(default_factory=dict)
    """When the newest reading that anybody may believe was made."""
    bad: set[str] = field(default_factory=set)
    """Sensors whose newest message is unreadable, pressed or low."""
    number: Counter[str] = field(default_factory=Counter)
    last: dict[str, tuple[Any, ...]] = field(default_factory=dict)
    waiting: list[tuple[float, str, tuple[Any, ...]]] = field(default_factory=list)
    due_s: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PERIODS_S, 0.0))
    set_back_s: float = -10.0

    def fault(self) -> None:
        """Something goes wrong now and then."""
        if self.now_s < SOUND_S or self.dice.random() > 0.05:
            return
        name, fault = self.dice.choice(list(PERIODS_S)), self.dice.choice(FAULTS)
        if fault == "set-back" and self.now_s > self.set_back_s + 3.0:
            self.clock_s -= self.dice.choice((0.5, 5.0, 50.0)) + 0.001
            self.set_back_s = self.now_s
            self.wrong = {n: w for n, w in self.wrong.items() if w[0] != "late"}
        elif fault != "late" or self.now_s > self.set_back_s + 3.0:
            self.wrong[name] = (fault, self.now_s + self.dice.uniform(0.05, 1.5))

    def sense(self) -> None:
        """Let every sensor say what is due, and deliver what is late."""
        for name, period_s in PERIODS_S.items():
            if self.now_s >= self.due_s[name]:
                self.due_s[name] += period_s
                self.say(name)
        for item in [one for one in self.waiting if one[0] <= self.now_s]:
            self.waiting.remove(item)
            self.deliver(item[1], item[2])

    def say(self, name: str) -> None:
        fault, until_s = self.wrong.get(name, ("", 0.0))
        if self.now_s > until_s:
            fault = ""
        if fault == "silent":
            return
        if fault == "frozen" and name in self.last:
            message = self.last[name]
            if name == "bumper" and (self.kind == "robotino" or not message[1]):
                return
            self.deliver(name, message)
            return
        self.number[name] += 1
        value = {
            "odometry": self.pose,
            "bumper": fault == "pressed",
            "battery": fault == "low",
            "camera": 0 if fault == "same-picture" else self.number[name],
        }[name]
        stamp_ns = round((self.clock_s + self.now_s) * 1e9)
        message = (value, stamp_ns, self.number[name], self.now_s, fault == "unreadable")
        self.last[name] = message
        late_s = self.dice.uniform(0.5, 2.0) if fault == "late" and self.kind != "robotino" else 0.0
        if late_s:
            self.waiting.append((self.now_s + late_s, name, message))
        else:
            self.deliver(name, message)
            if fault == "copies" and self.kind != "robotino":
                self.waiting.append((self.now_s + 1.0, name, message))

    def deliver(self, name: str, message: tuple[Any, ...]) -> None:
        value, _, _, made_s, unreadable = message
        if unreadable:
            if name == "bumper":
                self.bad.add(name)
        elif made_s > self.made_s.get(name, -1.0):
            self.made_s[name] = made_s
            bad = value is True
            (self.bad.add if bad else self.bad.discard)(name)
        if self.kind == "robotino":
            self.link.take(
                name, 200, b"\0" if unreadable else robotino(name, value, message), made_s
            )
            return
        payload = b"\0\1\0\0" if unreadable else ros2(name, value, message[1])
        attachment = ros2_names.packed(Attachment(message[2], message[1], b"g" * 16))
        sample = RawSample(name, payload, attachment, self.now_s + WAY_S)
        self.link.take(name, sample, self.now_s)

    def missing(self) -> list[str]:
        """Why the robot must not move now, as far as anybody can know."""
        old = [
            name
            for name, stale_s in STALE_S.items()
            if self.now_s - self.made_s.get(name, -9.0) > stale_s + SLACK_S
        ]
        unheard = {"battery"} if self.now_s < self.set_back_s + 1.0 else set()
        return [*old, *(self.bad - unheard)]


def picture(number: int) -> np.ndarray[Any, Any]:
    return np.random.default_rng(number).integers(0, 255, (12, 16, 3), np.uint8)


def robotino(name: str, value: Any, message: tuple[Any, ...]) -> bytes:
    if name == "odometry":
        return f"[{value.x_m},{value.y_m},{value.heading_rad},0,0,0,{message[2]}]".encode()
    if name == "camera":
        return bytes(simplejpeg.encode_jpeg(picture(value)))
    word = "value" if name == "bumper" else "batteryLow"
    return f'{{"{word}": {str(value).lower()}}}'.encode()


def ros2(name: str, value: Any, stamp_ns: int) -> bytes:
    if name == "odometry":
        return cdr.encode_odometry(value, STANDSTILL, stamp_ns)
    if name == "camera":
        return cdr.encode_image(picture(value), stamp_ns)
    if name == "bumper":
        return cdr.encode_bumper(value, "HazardDetectionVector", stamp_ns)
    return cdr.encode_battery(Battery(value, 15.0), "BatteryState", stamp_ns)


@pytest.fixture
def clocked(monkeypatch: pytest.MonkeyPatch) -> Callable[[str, int], Play]:
    """A robot of a kind in simulated time, driven until its sequence is over."""
    monkeypatch.setattr(hardware, "READING_S", 0.0)
    monkeypatch.setattr(hardware.threading, "Thread", _NoThread)
    monkeypatch.setattr("logging.Logger.warning", lambda *_: None)

    def run(kind: str, seed: int) -> Play:
        stale = {f"{name}_stale_s": stale_s for name, stale_s in STALE_S.items()}
        ros = {
            "transport": kind,
            "battery_topic": "battery",
            "bumper_type": "HazardDetectionVector",
        }
        config = config_of(
            kind="robotino",
            period_s=0.2,
            deadman_s=0.3,
            hardware=stale,
            **({} if kind == "robotino" else {"ros2": ros}),
        )
        link = Robotino(config) if kind == "robotino" else Ros2(config.robot.ros2)
        play = Play(kind, random.Random(f"{kind} {seed}"), link)
        robot = HardwareRobot(config.robot, link, lambda: play.now_s)
        while play.now_s < LONG_S:
            tick(play, robot)
        return play

    return run


def tick(play: Play, robot: HardwareRobot) -> None:
    """One step: the sensors, the bumper's thread, the driver, the sender, the wheels."""
    play.now_s += TICK_S
    play.fault()
    play.sense()
    if reading := play.link.bumper.get():
        robot._touched(reading.value)
    try:
        robot.run(0.0, stop_on_contact=True)
        if play.dice.random() < 0.2:
            robot.drive(play.dice.choice((AHEAD, LEFT, BACK, STANDSTILL)))
    except NotReady:
        pass
    if (velocity := robot._due(play.now_s)) is not None:
        if velocity.moving:
            assert not play.missing(), f"{play.now_s:.2f} s: {play.missing()}, {play.wrong}"
        robot._hand_over(velocity)
    driven = robot._driven
    step = Pose(driven.forward_m_s * TICK_S, 0.0, driven.turn_rad_s * TICK_S)
    play.pose = joined(play.pose, step)


@pytest.mark.parametrize("sequences", [12, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", ["robotino", "bridge", "rmw-zenoh"])
def test_no_robot_moves_without_the_readings_it_needs(
    kind: str, sequences: int, clocked: Callable[[str, int], Play]
) -> None:
    told = [clocked(kind, seed).link.told for seed in range(sequences)]
    moving = [sum(velocity.moving for velocity in one) for one in told]
    assert sum(moving) > 5 * sequences, "it is no robot that never moves"
