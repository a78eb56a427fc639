"""What counts as new and when it was made: stamps, numbers, pictures that change as robots move."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.robot_driver.real.freshness import (
    REST_S,
    SET_ROW,
    Pictures,
    RobotClock,
    Sequences,
    Stamps,
)
from services.robot_driver.robot import Pose

FAST = settings(deadline=None, max_examples=60, derandomize=True)

HERE, THERE = Pose(0.0, 0.0, 0.0), Pose(0.2, 0.0, 0.0)
A, B = np.zeros((4, 4, 3), np.uint8), np.ones((4, 4, 3), np.uint8)
S_NS, PERIOD_S, WAY_S = 10**9, 0.05, 0.02
ROBOT_S = 1.7e9
"""The robot's clock when ours is 0."""


def stamp_ns(robot_s: float) -> int:
    return round(robot_s * S_NS)


def judge_of(clock: RobotClock | None = None) -> Stamps:
    return Stamps(clock or RobotClock())


@FAST
@given(st.lists(st.integers(1, 10**10), min_size=1))
def test_only_a_stamp_above_all_before_is_new(stamps: list[int]) -> None:
    judge, newest = judge_of(), 0
    for stamp in stamps:  # all arrive at once
        assert (judge.made_s(stamp, 1.0) is not None) == (stamp > newest)
        newest = max(newest, stamp)


def test_a_frozen_sensor_never_becomes_new() -> None:
    judge = judge_of()
    assert judge.made_s(5, 0.0) is not None
    assert not any(judge.made_s(5, tick * PERIOD_S) is not None for tick in range(1000))


def test_without_stamps_everything_was_made_as_it_arrived() -> None:
    judge = judge_of()
    assert [judge.made_s(0, at_s) for at_s in (1.0, 2.0, 2.5)] == [1.0, 2.0, 2.5]


def test_what_takes_longer_than_the_fastest_message_is_older() -> None:
    judge = judge_of()
    assert judge.made_s(stamp_ns(ROBOT_S), WAY_S) == pytest.approx(WAY_S)
    assert judge.made_s(stamp_ns(ROBOT_S + 1.0), 1.3) == pytest.approx(1.0 + WAY_S, abs=2e-3)
    assert judge.made_s(stamp_ns(ROBOT_S + 2.0), 2.0) == pytest.approx(2.0)


def test_a_backlog_that_grows_makes_readings_old_and_drift_does_not() -> None:
    for rate, oldest_s in ((0.1, 5.0), (5e-4, 0.001)):
        judge, age_s = judge_of(), 0.0
        for tick in range(1200):
            made_s, arrived_s = tick * PERIOD_S, tick * PERIOD_S * (1.0 + rate) + WAY_S
            told_s = judge.made_s(stamp_ns(ROBOT_S + made_s), arrived_s)
            assert told_s is not None
            age_s = arrived_s - told_s
        assert age_s >= oldest_s if rate > 0.01 else age_s <= oldest_s


def test_pictures_are_as_old_as_their_stamps_tell_beside_the_odometry() -> None:
    clock = RobotClock()
    odometry, camera = judge_of(clock), judge_of(clock)
    odometry.made_s(stamp_ns(ROBOT_S), 0.0)
    assert camera.made_s(stamp_ns(ROBOT_S - 30.0), 0.01) == pytest.approx(-30.0, abs=0.01)
    own = judge_of()
    assert own.made_s(stamp_ns(ROBOT_S - 30.0), 0.01) == pytest.approx(0.01)


@pytest.mark.parametrize("step_s", [0.35, 1.0, 5.0, 3600.0])
def test_a_clock_that_was_set_back_is_followed_after_a_few_messages(step_s: float) -> None:
    clock = RobotClock()
    odometry, bumper = judge_of(clock), judge_of(clock)
    for tick in range(200):
        odometry.made_s(stamp_ns(ROBOT_S + tick * PERIOD_S), tick * PERIOD_S + WAY_S)
    bumper.made_s(stamp_ns(ROBOT_S + 199 * PERIOD_S), 199 * PERIOD_S + WAY_S)
    refused = 0
    for tick in itertools.count(200):  # the stamps are none of those before
        at_s = tick * PERIOD_S
        if odometry.made_s(stamp_ns(ROBOT_S + at_s - step_s + 0.001), at_s + WAY_S) is not None:
            break
        refused += 1
    assert refused == SET_ROW - 1
    pressed_s = bumper.made_s(stamp_ns(ROBOT_S + at_s - step_s), at_s + WAY_S)
    assert pressed_s == pytest.approx(at_s + WAY_S, abs=0.01), "what shares the clock follows"
    assert clock.stamp_ns(at_s) == pytest.approx(stamp_ns(ROBOT_S + at_s - step_s), abs=S_NS // 10)


@pytest.mark.parametrize("stops", [False, True], ids=["goes-on", "stops"])
def test_copies_that_come_a_second_late_stay_refused(stops: bool) -> None:
    judge = judge_of()
    for tick in range(200):
        at_s = tick * PERIOD_S
        if tick < 100 or not stops:
            assert judge.made_s(stamp_ns(ROBOT_S + at_s), at_s) is not None
        if 20 <= tick < 120:
            assert judge.made_s(stamp_ns(ROBOT_S + at_s - 1.0), at_s + 0.01) is None
            assert judge.copied


def test_a_burst_of_late_messages_is_no_clock_that_was_set_back() -> None:
    judge = judge_of()
    judge.made_s(stamp_ns(ROBOT_S), 0.0)
    burst = [stamp_ns(ROBOT_S - 5.0 + tick * PERIOD_S) for tick in range(50)]
    assert [judge.made_s(stamp, 0.01) for stamp in burst] == [None] * 50
    assert not judge.copied


def test_old_messages_beside_a_topic_that_goes_on_do_not_set_the_clock() -> None:
    clock = RobotClock()
    odometry, camera = Stamps(clock), Stamps(clock)
    for tick in range(100):
        now_s = tick * PERIOD_S
        assert odometry.made_s(stamp_ns(ROBOT_S + now_s - WAY_S), now_s) is not None
        if tick % 2:
            late_s = 30.0 if tick > 20 else 0.0
            made_s = camera.made_s(stamp_ns(ROBOT_S + now_s - WAY_S - late_s), now_s)
            assert (made_s is None) == (tick > 20)
    assert clock.settings == 0


def test_what_is_still_of_the_time_before_a_clock_was_set_back_is_not_new() -> None:
    clock = RobotClock()
    odometry, camera = judge_of(clock), judge_of(clock)
    for tick in range(60):
        back_s = 50.001 if tick >= 40 else 0.0
        odometry.made_s(stamp_ns(ROBOT_S + tick * PERIOD_S - back_s), tick * PERIOD_S)
    assert camera.made_s(stamp_ns(ROBOT_S + 39 * PERIOD_S), 60 * PERIOD_S) is None
    made_s = odometry.made_s(stamp_ns(ROBOT_S + 60 * PERIOD_S - 50.001), 60 * PERIOD_S)
    assert made_s == pytest.approx(60 * PERIOD_S, abs=0.01)


def test_numbers_grow_by_sender() -> None:
    judge = Sequences()
    assert judge.new(b"a", 5)
    assert judge.new(b"b", 1)
    assert not judge.new(b"a", 5)
    assert not judge.new(b"a", 4)
    assert judge.new(b"a", 6)
    assert judge.new(b"b", 2)


def test_few_senders_are_remembered() -> None:
    judge = Sequences()
    for number in range(1000):
        assert judge.new(str(number).encode(), 1)
    assert len(judge._last) <= 16


def test_a_standing_robot_may_see_the_same_for_long() -> None:
    judge = Pictures()
    assert all(judge.new(A, HERE, 0.1 * tick) for tick in range(100))


def test_a_moving_robot_sees_something_else_or_its_camera_is_frozen() -> None:
    judge = Pictures()
    assert judge.new(A, HERE, 0.0)
    assert not judge.new(A, THERE, 0.1)
    assert judge.new(B, THERE, 0.2)
    assert judge.new(B, Pose(0.2, 0.005, 0.01), 0.3)
    assert not judge.new(B, Pose(0.2, 0.0, 0.2), 0.4), "turned"


def test_a_robot_that_stopped_may_see_the_same_again_but_less_and_less_often() -> None:
    judge, now_s, x_m, waits = Pictures(), 0.0, 0.0, []
    judge.new(A, HERE, 0.0)
    for _ in range(4):
        x_m, stopped_s = x_m + 0.1, now_s
        while not judge.new(A, Pose(x_m, 0.0, 0.0), now_s):
            now_s += 0.1
        waits.append(now_s - stopped_s)
    assert waits == pytest.approx([REST_S, 2 * REST_S, 4 * REST_S, 8 * REST_S], abs=0.15)
    assert judge.new(B, Pose(x_m, 0.0, 0.0), now_s)
    assert not judge.new(B, Pose(x_m + 0.1, 0.0, 0.0), now_s)
    assert judge.new(B, Pose(x_m + 0.1, 0.0, 0.0), now_s + REST_S), "another picture, as at first"


def test_without_odometry_pictures_are_believed() -> None:
    judge = Pictures()
    assert judge.new(A, None, 0.0)
    assert judge.new(A, None, 0.1)
    assert judge.new(A, HERE, 0.2)
    assert not judge.new(A, THERE, 0.3)
