"""What the driver relies on, whatever robot it drives (H1): one suite for all of them."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import suppress

import numpy as np
import pytest
from robots import SPEED_M_S, SUBJECTS, TURN_RAD_S, Subject

from benchmarks.waiting import wait_until
from services.robot_driver.driver import Driver
from services.robot_driver.host import Host
from services.robot_driver.recovery import WatchedRobot, back_off
from services.robot_driver.robot import STANDSTILL, NotReady, Pose, Velocity
from services.robot_driver.safety import Safety
from shared.messages import Motion

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]
AHEAD = Velocity(SPEED_M_S, 0.0, 0.0)


@pytest.fixture(params=sorted(SUBJECTS))
def subject(request: pytest.FixtureRequest) -> Iterator[Subject]:
    with SUBJECTS[request.param]() as one:
        yield one


def way(a: Pose, b: Pose) -> float:
    return math.hypot(b.x_m - a.x_m, b.y_m - a.y_m)


def rest(subject: Subject) -> None:
    """Tell it to stop and wait until it stands."""
    subject.robot.drive(STANDSTILL)
    subject.robot.run(subject.stop_s + 0.1, stop_on_contact=False)

    def stands() -> bool:
        before = subject.true_pose()
        subject.robot.run(0.1, stop_on_contact=False)
        return subject.true_pose() == before

    wait_until(stands, 30, "the robot stands")


def drive(subject: Subject, velocity: Velocity, duration_s: float) -> bool:
    """Drive in slices as the driver does, then rest; whether there was contact."""
    subject.robot.drive(velocity)
    contact = False
    for _ in range(round(duration_s / 0.02)):
        contact = subject.robot.run(0.02, stop_on_contact=True)
        if contact:
            break
    rest(subject)
    return contact


def test_it_senses_a_picture_a_pose_and_no_contact(subject: Subject) -> None:
    sensed = subject.robot.sense()
    assert (sensed.image.dtype, sensed.image.shape) == (np.uint8, (50, 75))
    assert 10 < sensed.image.mean() < 245
    assert sensed.image.std() > 5
    assert not sensed.contact
    felt = subject.robot.feel()
    assert way(felt.pose, sensed.pose) < 0.01
    assert not felt.contact


def test_it_drives_ahead_and_its_odometry_tells_how_far(subject: Subject) -> None:
    start, true_start = subject.robot.feel().pose, subject.true_pose()
    assert not drive(subject, AHEAD, 2.0)
    wait_until(
        lambda: (
            way(start, subject.robot.feel().pose)
            == pytest.approx(way(true_start, subject.true_pose()), abs=0.01)
        ),
        20,
        "odometry agrees with what happened",
    )
    assert 0.1 < way(true_start, subject.true_pose()) < 0.8
    end = subject.robot.feel().pose
    ahead = math.atan2(end.y_m - start.y_m, end.x_m - start.x_m)
    assert math.remainder(ahead - start.heading_rad, 2 * math.pi) == pytest.approx(0.0, abs=0.1)


def test_it_turns_counter_clockwise_on_the_spot(subject: Subject) -> None:
    start, place = subject.robot.feel().pose, subject.true_pose()
    drive(subject, Velocity(0.0, 0.0, TURN_RAD_S), 1.5)
    wait_until(
        lambda: 0.3 < subject.robot.feel().pose.heading_rad - start.heading_rad < 2.0,
        20,
        "it has turned left",
    )
    assert way(place, subject.true_pose()) < 0.01


def test_what_it_sees_changes_as_it_moves(subject: Subject) -> None:
    before = subject.robot.sense().image.astype(int)
    drive(subject, Velocity(0.0, 0.0, TURN_RAD_S), 1.5)
    wait_until(
        lambda: np.abs(subject.robot.sense().image.astype(int) - before).mean() > 5,
        20,
        "another picture",
    )


def test_time_passes_as_told(subject: Subject) -> None:
    began_s = time.monotonic()
    own_s = subject.robot.now_s()
    for _ in range(25):
        subject.robot.run(0.02, stop_on_contact=True)
    assert time.monotonic() - began_s >= 0.45
    assert subject.robot.now_s() - own_s >= 0.45


def test_contact_stops_it_and_recovery_frees_it(subject: Subject) -> None:
    subject.robot.drive(AHEAD)
    contact = False
    for _ in range(3000):
        if contact := subject.robot.run(0.02, stop_on_contact=True):
            break
    assert contact
    rest(subject)
    pressed = subject.true_pose()
    subject.robot.run(0.5, stop_on_contact=False)
    assert subject.true_pose() == pressed
    robot = subject.config.robot
    watched = WatchedRobot(subject.robot, Safety(robot), Host(), 0.02)
    back_off(watched, robot, subject.robot.feel().pose.heading_rad + 1.0)
    rest(subject)
    wait_until(lambda: not subject.robot.feel().contact, 20, "the bumper is free")
    assert 0.1 < way(pressed, subject.true_pose()) < robot.recovery_distance_m + 0.2


def test_a_wish_that_is_no_velocity_is_standstill(subject: Subject) -> None:
    watched = WatchedRobot(subject.robot, Safety(subject.config.robot), Host(), 0.02)
    place = subject.true_pose()
    for bad in (math.nan, math.inf):
        watched.drive(Velocity(bad, 0.0, 0.0))
        watched.run(0.3, stop_on_contact=True)
    assert way(place, subject.true_pose()) < 0.001


def test_without_calls_it_stops_by_itself(subject: Subject) -> None:
    subject.robot.drive(AHEAD)
    for _ in range(50):
        subject.robot.run(0.02, stop_on_contact=True)
    place = subject.true_pose()

    since_s, seen = time.monotonic(), place

    def stands() -> bool:
        nonlocal since_s, seen
        if (pose := subject.true_pose()) != seen:
            since_s, seen = time.monotonic(), pose
        return time.monotonic() >= since_s + 0.2

    wait_until(stands, 20, "the robot stands")
    allowed_s = 2 * subject.config.robot.period_s + subject.stop_s + 1.0
    assert way(place, subject.true_pose()) < SPEED_M_S * allowed_s


def test_its_state_fits_itself(subject: Subject) -> None:
    subject.robot.restore(subject.robot.state())
    with pytest.raises(ValueError, match="robot state"):
        subject.robot.restore({"x_m": 1.0})


def test_a_driver_drives_it(subject: Subject) -> None:
    driver = Driver(subject.config, subject.robot, "a" * 12)
    start = subject.true_pose()
    for sequence in range(4):
        observation = driver.observe()
        assert (observation.sequence, observation.interruption) == (sequence, "")
        driver.start(0)
        for _ in range(20):
            assert not driver.advance(0.02)
        driver.settle(False)
    driver.halt()
    rest(subject)
    assert way(start, subject.true_pose()) > 0.05
    assert driver.report(0).reason == ""


def fit_again(driver: Driver) -> bool:
    with suppress(AssertionError):
        wait_until(driver.fit, 60, "the robot is fit to drive again")
    return driver.fit()


def carry_out(driver: Driver, motion: Motion) -> bool:
    """One period of a motion, as the service does it; whether it ended in contact."""
    contact = False
    try:
        if driver.start_motion(motion):
            for _ in range(round(driver._config.robot.period_s / 0.02)):
                contact = driver.advance(0.02)
                if contact:
                    break
            driver.settle(contact)
        else:
            driver.halt()
            driver.look_again("")
    except NotReady as problem:  # a stall of this machine
        driver.block(str(problem))
        assert fit_again(driver), driver.reason
    return contact


def test_it_turns_on_the_spot_and_creeps_into_no_wall(subject: Subject) -> None:
    driver = Driver(subject.config, subject.robot, "a" * 12)
    start = subject.true_pose()

    def turned() -> bool:
        carry_out(driver, "turn-left")
        heading_rad = subject.true_pose().heading_rad
        return math.remainder(heading_rad - start.heading_rad, 2.0 * math.pi) > 0.1

    wait_until(turned, 60, "it turns")
    rest(subject)
    assert way(start, subject.true_pose()) < 0.03
    wait_until(lambda: carry_out(driver, "back"), 120, "it meets the wall behind it")
    driver.halt()
    rest(subject)
    seen = driver.observe()
    assert (seen.sequence, seen.bump, seen.interruption) == (0, True, "moved")

    def free() -> bool:
        subject.robot.run(0.1, stop_on_contact=False)
        return not subject.robot.feel().contact

    wait_until(free, 30, "it let go of the wall")
    before = subject.true_pose()

    def creeps_away() -> bool:
        assert not carry_out(driver, "forward")
        return way(before, subject.true_pose()) > 0.05

    wait_until(creeps_away, 60, "it creeps away")
    rest(subject)


def test_closing_stops_it_and_may_happen_twice(subject: Subject) -> None:
    subject.robot.drive(AHEAD)
    for _ in range(50):
        subject.robot.run(0.02, stop_on_contact=True)
    subject.robot.close()
    subject.robot.close()
