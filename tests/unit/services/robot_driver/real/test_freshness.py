"""What counts as new: growing stamps and numbers, pictures that change when the robot moves."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from services.robot_driver.real.freshness import NEW_CLOCK_NS, Pictures, Sequences, Stamps
from services.robot_driver.robot import Pose

FAST = settings(deadline=None, max_examples=60, derandomize=True)

HERE, THERE = Pose(0.0, 0.0, 0.0), Pose(0.2, 0.0, 0.0)
A, B = np.zeros((4, 4, 3), np.uint8), np.ones((4, 4, 3), np.uint8)


@FAST
@given(st.lists(st.integers(1, NEW_CLOCK_NS), min_size=1))
def test_only_a_stamp_above_all_before_is_new(stamps: list[int]) -> None:
    judge, newest = Stamps(), 0
    for stamp in stamps:
        assert judge.new(stamp) == (stamp > newest)
        newest = max(newest, stamp)


def test_a_frozen_sensor_never_becomes_new() -> None:
    judge = Stamps()
    assert judge.new(5)
    assert not any(judge.new(5) for _ in range(1000))


def test_without_stamps_everything_is_new() -> None:
    judge = Stamps()
    assert all(judge.new(0) for _ in range(3))


def test_a_clock_that_was_set_back_is_followed() -> None:
    judge = Stamps()
    assert judge.new(100 * NEW_CLOCK_NS)
    assert judge.new(50 * NEW_CLOCK_NS)
    assert not judge.new(50 * NEW_CLOCK_NS - 1)
    assert judge.new(50 * NEW_CLOCK_NS + 1)


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
    assert all(judge.new(A, HERE) for _ in range(100))


def test_a_moving_robot_sees_something_else_or_its_camera_is_frozen() -> None:
    judge = Pictures()
    assert judge.new(A, HERE)
    assert not judge.new(A, THERE)
    assert not judge.new(A, THERE), "it stays so, standing or not"
    assert judge.new(B, THERE)
    assert judge.new(B, Pose(0.2, 0.005, 0.01))
    assert not judge.new(B, Pose(0.2, 0.0, 0.2)), "turned"


def test_without_odometry_pictures_are_believed() -> None:
    judge = Pictures()
    assert judge.new(A, None)
    assert judge.new(A, None)
    assert judge.new(A, HERE)
    assert not judge.new(A, THERE)
