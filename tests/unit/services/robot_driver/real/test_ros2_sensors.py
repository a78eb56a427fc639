"""What is made of a ROS 2 robot's messages, in simulated time."""

from __future__ import annotations

import numpy as np
import pytest

from services.robot_driver.real import cdr, ros2_types
from services.robot_driver.real.link import Battery
from services.robot_driver.real.ros2_names import Endpoint
from services.robot_driver.real.ros2_sensors import PRESS, Ros2Sensors
from services.robot_driver.robot import STANDSTILL, Pose
from shared.config import Ros2Config
from shared.foreign_bus import RawSample

ROBOT_NS, S_NS = 1_700_000_000 * 10**9, 10**9
HAZARDS = "HazardDetectionVector"
WHITE = np.full((12, 16, 3), 250, np.uint8)


def sensors_of(**ros2: object) -> Ros2Sensors:
    tree = {"battery_topic": "battery_state", "bumper_type": HAZARDS, **ros2}
    return Ros2Sensors(Ros2Config.model_validate(tree))


def say(sensors: Ros2Sensors, name: str, raw: bytes, now_s: float) -> None:
    sensors.take(name, RawSample(name, raw, b"", now_s), now_s)


def odometry(sensors: Ros2Sensors, now_s: float, x_m: float = 0.0, clock_s: float = 0.0) -> None:
    stamp_ns = ROBOT_NS + round((now_s + clock_s) * S_NS)
    say(sensors, "odometry", cdr.encode_odometry(Pose(x_m, 0, 0), STANDSTILL, stamp_ns), now_s)


def hazards(sensors: Ros2Sensors, pressed: bool, now_s: float, stamp_s: float = 0.0) -> None:
    stamp_ns = ROBOT_NS + round((now_s + stamp_s) * S_NS)
    say(sensors, "bumper", cdr.encode_bumper(pressed, HAZARDS, stamp_ns), now_s)


def published(sensors: Ros2Sensors) -> None:
    topic = sensors._topics["bumper"]
    told = Endpoint("publishes", topic, ros2_types.FULL_NAMES[HAZARDS])
    sensors._endpoints = frozenset({told})


def test_a_bumper_told_on_change_counts_until_a_message_is_unreadable() -> None:
    sensors = sensors_of(bumper_on_change=True)
    published(sensors)
    odometry(sensors, 1.0)
    sensors.explain()
    assert (sensors.bumper.get(), sensors.bumper.note) == (None, PRESS)
    for pressed in (True, False):
        hazards(sensors, pressed, 1.1 + (not pressed))
        odometry(sensors, 1.2 + (not pressed))
        reading = sensors.bumper.get()
        assert reading is not None
        assert (reading.value, reading.stamp_s) == (pressed, pytest.approx(1.2 + (not pressed)))
    say(sensors, "bumper", b"\0\1\0\0\1", 2.3)
    odometry(sensors, 2.4)
    assert sensors.bumper.get() is None
    assert sensors.bumper.note.startswith("truncated or of another type")
    hazards(sensors, False, 2.5)
    odometry(sensors, 2.6)
    assert sensors.bumper.get() is not None
    hazards(sensors, True, 2.7, stamp_s=-1.0)
    assert sensors.bumper.get() is None, "something came late: nobody knows how it is now"


def test_a_lifted_robot_has_no_bumper_until_it_stands_again() -> None:
    sensors = sensors_of()
    hazards(sensors, False, 1.0)
    raw = cdr.encode_bumper(True, HAZARDS, 0, hazard=cdr.WHEEL_DROP)
    say(sensors, "bumper", raw, 1.1)
    assert (sensors.bumper.get(), sensors.bumper.note) == (None, "lifted")
    hazards(sensors, False, 1.2)
    assert sensors.bumper.get() is not None


def test_a_battery_speaks_percent_once_it_told_more_than_one() -> None:
    sensors = sensors_of()
    for charge, low in ((0.9, False), (12.0, True), (0.9, True), (90.0, False), (None, None)):
        raw = cdr.encode_battery(Battery(False, 15.0), "BatteryState", 0)
        if charge is not None:
            message = ros2_types.decode(raw, "BatteryState")
            raw = ros2_types.encode(
                type(message)(**{**vars(message), "percentage": charge}), "BatteryState"
            )
        say(sensors, "battery", raw if charge is not None else raw[:-9], 1.0)
        reading = sensors.battery.get()
        assert (reading and reading.value.low) is low


@pytest.mark.parametrize(("clock", "age_s"), [("robot", 30.0), ("own", 0.0)])
def test_pictures_that_are_old_by_the_robots_clock_are_old(clock: str, age_s: float) -> None:
    sensors = sensors_of(camera_clock=clock)
    odometry(sensors, 1.0)
    picture = cdr.encode_image(WHITE, ROBOT_NS + round(1.1 * S_NS) - 30 * S_NS)
    say(sensors, "camera", picture, 1.1)
    reading = sensors.camera.get()
    assert reading is not None
    assert 1.1 - reading.stamp_s == pytest.approx(age_s, abs=0.01)
    assert reading.facts.startswith("16x12 rgb8")
    assert ("another clock" in sensors.camera.note) == (age_s > 0.0)


def test_a_camera_that_sees_the_same_on_and_on_is_told_of_when_the_robot_moved() -> None:
    sensors = sensors_of()
    for at_s, x_m, number in ((1.0, 0.0, 1), (1.1, 0.0, 2), (1.2, 0.1, 2), (4.0, 0.1, 3)):
        odometry(sensors, at_s, x_m)
        say(sensors, "camera", cdr.encode_image(WHITE, ROBOT_NS + round(at_s * S_NS)), at_s)
        reading = sensors.camera.get()
        assert reading is not None
        assert reading.number == number


def test_encodings_that_nobody_reads_are_named_with_those_that_are() -> None:
    sensors = sensors_of()
    raw = cdr.encode_image(WHITE, 1).replace(b"rgb8", b"rgbX")
    say(sensors, "camera", raw, 1.0)
    assert sensors.camera.note.startswith("unknown encoding: 'rgbX', accepted: mono8, ")
    assert dict(sensors.faults) == {"camera: unknown encoding": 1}
