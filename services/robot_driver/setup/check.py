"""`corridor robot check`: every sensor of a real robot, looked at for a while; nothing moves."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from services.robot_driver.real.link import Link, Newest, Reading
from services.robot_driver.robot import RobotFault
from shared.config import RobotConfig
from shared.errors import RobotMissing

LOOK_S = 0.02
"""How often the slots are looked at."""
FAULTS = 5
"""Kinds of faults that are told of, the most frequent ones."""
RATE_SLACK = 0.7
"""A sensor as slow as this part of the wanted rate still does."""


@dataclass
class Seen:
    """What one slot told so far."""

    slot: Newest[Any]
    wanted_hz: float
    """Readings a second that the robot needs; 0: they come when something changes."""
    oldest_s: float
    """Age after which the robot stands."""
    first: int = 0
    """Number of the last reading before we looked."""
    newest: Reading[Any] | None = None
    ages_s: list[float] = field(default_factory=list)
    """Of each reading when it was first seen here."""

    def look(self, now_s: float) -> None:
        """Take a new reading, if there is one."""
        reading = self.slot.get()
        if reading is None or (self.newest is not None and reading.number == self.newest.number):
            return
        if self.newest is None:
            self.first = reading.number - 1
        self.newest = reading
        self.ages_s.append(now_s - reading.stamp_s)

    def rate_hz(self, duration_s: float) -> float:
        """Readings a second."""
        return (self.newest.number - self.first) / duration_s if self.newest else 0.0

    def problem(self, duration_s: float, now_s: float) -> str:
        """What is wrong; empty when nothing is."""
        note = f": {self.slot.note}" if self.slot.note else ""
        if self.newest is None or self.slot.get() is None:
            return f"no reading{note}"
        if now_s - self.newest.stamp_s > self.oldest_s:
            return f"nothing new for {now_s - self.newest.stamp_s:.1f} s{note}"
        if self.rate_hz(duration_s) < RATE_SLACK * self.wanted_hz:
            return f"{self.rate_hz(duration_s):.1f} readings a second, expected {self.wanted_hz:g}"
        return ""


def check(
    robot: RobotConfig,
    link: Link,
    duration_s: float,
    echo: Callable[[str], None],
    clock: Callable[[], float] = time.monotonic,
    wait: Callable[[float], object] = time.sleep,
) -> list[str]:
    """Look at a robot for a while; returns what keeps it from driving. Raises RobotMissing."""
    try:
        link.open()
    except RobotFault as error:
        raise RobotMissing(str(error)) from error
    try:
        sensors = _sensors(robot, link)
        start_s = clock()
        while (now_s := clock()) < start_s + duration_s:
            for seen in sensors.values():
                seen.look(now_s)
            wait(LOOK_S)
        for line in _table(sensors, duration_s):
            echo(line)
        problems = list(_problems(sensors, link, duration_s, clock()))
    finally:
        link.close()
    for name, count in link.faults.most_common(FAULTS):
        echo(f"{count} times {name}")
    for problem in problems:
        echo(f"! {problem}")
    return problems


def _sensors(robot: RobotConfig, link: Link) -> dict[str, Seen]:
    ages, wanted_hz = robot.hardware, 1.0 / robot.period_s
    return {
        "camera": Seen(link.camera, wanted_hz, ages.camera_stale_s),
        "odometry": Seen(link.odometry, wanted_hz, ages.odometry_stale_s),
        "bumper": Seen(link.bumper, wanted_hz, ages.bumper_stale_s),
        "battery": Seen(link.battery, 0.0, ages.battery_stale_s),
    }


def _table(sensors: dict[str, Seen], duration_s: float) -> Iterator[str]:
    yield f"{'sensor':9} {'per second':>10} {'age, ms':>8} {'longest':>8}  newest"
    for name, seen in sensors.items():
        if seen.newest is None:
            yield f"{name:9} {'-':>10} {'-':>8} {'-':>8}  {seen.slot.note or 'nothing came'}"
            continue
        middle, longest = 1e3 * sorted(seen.ages_s)[len(seen.ages_s) // 2], 1e3 * max(seen.ages_s)
        yield (
            f"{name:9} {seen.rate_hz(duration_s):10.1f} {middle:8.0f} {longest:8.0f}  "
            f"{_newest(name, seen.newest)}"
        )


def _newest(name: str, reading: Reading[Any]) -> str:
    """The newest reading in words."""
    value = reading.value
    if name == "camera":
        text = f"grey values {value.min()} to {value.max()}"
    elif name == "odometry":
        text = f"x {value.x_m:.3f} m, y {value.y_m:.3f} m, heading {value.heading_rad:.3f} rad"
    elif name == "bumper":
        text = "pressed" if value else "free"
    else:
        known = {True: "low", False: "good", None: "unknown"}[value.low]
        text = known + ("" if value.voltage_v is None else f", {value.voltage_v:.1f} V")
    return ", ".join(filter(None, (text, reading.facts)))


def _problems(
    sensors: dict[str, Seen], link: Link, duration_s: float, now_s: float
) -> Iterator[str]:
    for name, seen in sensors.items():
        problem = seen.problem(duration_s, now_s)
        if problem and (name != "battery" or seen.newest is not None):
            yield f"{name}: {problem}"
    bumper, battery = link.bumper.get(), link.battery.get()
    if bumper is not None and bumper.value:
        yield "bumper: pressed"
    if battery is not None and battery.value.low:
        yield "battery: low"
    if obstacle := link.obstacle():
        yield obstacle
