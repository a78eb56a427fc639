"""Odometry seen from its first reading, whatever the robot does to its own counting."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.robot_driver.real.odometry import OdometryFrame, between, joined
from services.robot_driver.robot import Pose

FAST = settings(deadline=None, max_examples=80, derandomize=True)
place = st.floats(-50.0, 50.0)
poses = st.builds(Pose, place, place, st.floats(-3.1, 3.1))


def near(a: Pose, b: Pose) -> None:
    assert (a.x_m, a.y_m) == pytest.approx((b.x_m, b.y_m), abs=1e-6)
    turn = math.remainder(a.heading_rad - b.heading_rad, 2 * math.pi)
    assert turn == pytest.approx(0.0, abs=1e-6)


@FAST
@given(poses, poses)
def test_a_step_leads_where_it_was_measured(start: Pose, end: Pose) -> None:
    near(joined(start, between(start, end)), end)


@FAST
@given(poses, st.lists(st.tuples(st.floats(-0.1, 0.1), st.floats(-0.3, 0.3)), max_size=20))
def test_the_first_pose_is_the_origin_and_motion_is_kept(
    start: Pose, steps: list[tuple[float, float]]
) -> None:
    frame, raw, true = OdometryFrame(), start, Pose(0.0, 0.0, 0.0)
    near(frame.pose(raw, 0.0), true)
    for number, (way, turn) in enumerate(steps):
        step = Pose(way, 0.0, turn)
        raw, true = joined(raw, step), joined(true, step)
        near(frame.pose(raw, 0.1 * (number + 1)), true)
    assert frame.jumps == 0


def test_a_jump_leaves_no_trace_but_a_count() -> None:
    frame = OdometryFrame()
    frame.pose(Pose(5.0, 5.0, 1.0), 0.0)
    before = frame.pose(Pose(5.1, 5.0, 1.0), 0.1)
    assert frame.pose(Pose(0.0, 0.0, 0.0), 0.2) == before
    assert frame.jumps == 1
    after = frame.pose(Pose(0.1, 0.0, 0.0), 0.3)
    assert math.hypot(after.x_m - before.x_m, after.y_m - before.y_m) == pytest.approx(0.1)
    assert frame.jumps == 1
