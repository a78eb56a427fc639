"""Odometry seen from its first reading, whatever the robot does to its own counting."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.robot_driver.real.odometry import (
    PAUSE_S,
    TRIES,
    MotionWatch,
    OdometryFrame,
    between,
    joined,
)
from services.robot_driver.robot import STANDSTILL, Pose, Velocity

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


REST_S, TICK_S = 0.7, 0.02
AHEAD = Velocity(0.2, 0.0, 0.0)


class Watched:
    """A robot that is told to drive and moves, or does not."""

    def __init__(self) -> None:
        self.watch, self.now_s, self.pose = MotionWatch(REST_S), 0.0, Pose(0.0, 0.0, 0.0)

    def go(self, told: Velocity, speed_m_s: float, duration_s: float, turn: float = 0.0) -> str:
        """Let time pass; the first problem, empty when there is none."""
        for _ in range(round(duration_s / TICK_S)):
            self.now_s += TICK_S
            self.pose = joined(self.pose, Pose(speed_m_s * TICK_S, 0.0, turn * TICK_S))
            self.watch.told(told, self.now_s, pressed=False)
            self.watch.moved(self.pose, self.now_s, self.now_s)
            if problem := self.watch.problem(self.now_s):
                return problem
        return ""


def test_a_robot_that_does_as_told_is_well() -> None:
    """Also with a delay, scaled and a little faster, in short taps, and coasting."""
    robot = Watched()
    assert not robot.go(STANDSTILL, 0.0, 5.0)
    for told, speed_m_s, turn in ((AHEAD, 0.15, 0.0), (AHEAD, 0.22, 0.1), (AHEAD, 0.01, 0.0)):
        assert not robot.go(told, 0.0, 0.4)
        assert not robot.go(told, speed_m_s, 3.0, turn)
        assert not robot.go(STANDSTILL, speed_m_s, 0.5)
        assert not robot.go(STANDSTILL, 0.0, 3.0)


@pytest.mark.parametrize("told", [AHEAD, Velocity(0.0, 0.0, -0.5)])
def test_odometry_that_stands_is_noticed_within_a_second_and_tried_a_few_times(
    told: Velocity,
) -> None:
    robot, waits = Watched(), []
    for _ in range(TRIES + 1):
        began_s = robot.now_s
        assert "stands" in robot.go(told, 0.0, 1.0)
        stopped_s = robot.now_s
        assert stopped_s - began_s < 0.9
        while robot.watch.problem(robot.now_s) and robot.now_s < stopped_s + 60.0:
            robot.go(STANDSTILL, 0.0, TICK_S)
        waits.append(robot.now_s - stopped_s)
    assert waits[:TRIES] == pytest.approx([PAUSE_S, 2 * PAUSE_S, 4 * PAUSE_S], abs=0.05)
    assert waits[TRIES] >= 60.0
    assert "push it" in robot.watch.problem(robot.now_s)
    robot.pose = joined(robot.pose, Pose(0.01, 0.0, 0.0))
    assert not robot.go(STANDSTILL, 0.0, 1.0)


def test_orders_that_never_last_long_add_up() -> None:
    robot = Watched()
    problems = [robot.go(told, 0.0, 0.2) for told in (AHEAD, STANDSTILL) * 10]
    assert any("stands" in problem for problem in problems)


@pytest.mark.parametrize(("speed_m_s", "turn"), [(0.2, 0.0), (-0.1, 0.0), (0.0, 0.5)])
def test_motion_that_nobody_ordered_is_noticed_within_a_second_until_it_ends(
    speed_m_s: float, turn: float
) -> None:
    robot = Watched()
    robot.go(AHEAD, 0.2, 3.0)
    robot.go(STANDSTILL, 0.0, 2.5)
    pushed_s = robot.now_s
    assert "nobody told it to" in robot.go(STANDSTILL, speed_m_s, 5.0, turn)
    assert robot.now_s - pushed_s < 1.0
    for _ in range(60):
        robot.go(STANDSTILL, 0.0, TICK_S)
    assert not robot.watch.problem(robot.now_s)


def test_a_wall_may_hold_a_robot_whose_bumper_is_pressed() -> None:
    watch = MotionWatch(REST_S)
    for tick in range(500):
        watch.told(AHEAD, tick * TICK_S, pressed=True)
        watch.moved(Pose(0.0, 0.0, 0.0), tick * TICK_S, tick * TICK_S)
    assert not watch.problem(10.0)
