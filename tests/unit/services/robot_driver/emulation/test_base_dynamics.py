"""The emulated base: delay, ramps, limits, watchdog; whatever it is told, it comes to rest."""

from __future__ import annotations

import math

import pytest
from fake_link import Plane
from hypothesis import given, settings
from hypothesis import strategies as st

from services.robot_driver.emulation.dynamics import (
    CREATE3,
    ROBOTINO,
    STEP_S,
    BaseDynamics,
    EmulatedBase,
)
from services.robot_driver.robot import STANDSTILL, Velocity

FAST = settings(deadline=None, max_examples=60, derandomize=True)
AHEAD = Velocity(0.2, 0.0, 0.0)


def base_of(dynamics: BaseDynamics = ROBOTINO) -> EmulatedBase:
    return EmulatedBase(Plane(), dynamics, 0.0)


def keep_telling(base: EmulatedBase, velocity: Velocity, duration_s: float) -> None:
    for number in range(round(duration_s / STEP_S)):
        if number % 5 == 0:
            base.command(velocity, base.now_s)
        base.step(STEP_S)


def test_nothing_moves_before_the_delay_is_over() -> None:
    base = base_of()
    keep_telling(base, AHEAD, 0.18)
    assert base.velocity == STANDSTILL
    assert base.still_since_s == 0.0
    keep_telling(base, AHEAD, 0.1)
    assert base.velocity.forward_m_s > 0.0
    assert base.still_since_s is None


def test_speed_follows_the_ramp_and_odometry_looks_along_the_start() -> None:
    base = base_of()
    keep_telling(base, AHEAD, 0.2 + 0.37)
    assert base.velocity.forward_m_s == pytest.approx(0.37 * ROBOTINO.accel_m_s2, abs=0.015)
    keep_telling(base, AHEAD, 1.0)
    assert base.velocity == AHEAD
    assert base.odometry.x_m > 0.1
    assert (base.odometry.y_m, base.odometry.heading_rad) == pytest.approx((0.0, 0.0))


def test_a_stop_takes_delay_and_ramp_and_no_more() -> None:
    base = base_of()
    keep_telling(base, AHEAD, 3.0)
    at_s = base.now_s
    keep_telling(base, STANDSTILL, ROBOTINO.stop_time_s(AHEAD) + STEP_S)
    assert base.still_since_s is not None
    assert at_s + ROBOTINO.delay_s < base.still_since_s <= at_s + ROBOTINO.stop_time_s(AHEAD)


def test_silence_stops_the_base() -> None:
    base = base_of()
    keep_telling(base, AHEAD, 3.0)
    last_s = base.commands[-1].at_s
    base.run_until(base.now_s + 5.0)
    assert base.watchdog_stops == 1
    assert base.still_since_s is not None
    longest_s = ROBOTINO.watchdog_s + ROBOTINO.stop_time_s(AHEAD) + STEP_S
    assert base.still_since_s - last_s <= longest_s


def test_commands_are_cut_and_creeping_is_ignored() -> None:
    base = base_of()
    keep_telling(base, Velocity(2.0, 0.009, 0.03), 5.0)
    assert base.velocity == Velocity(ROBOTINO.max_speed_m_s, 0.0, 0.0)


def test_a_base_on_two_wheels_does_not_go_sideways() -> None:
    base = base_of(CREATE3)
    keep_telling(base, Velocity(0.0, 0.2, 1.0), 2.0)
    assert base.velocity == Velocity(0.0, 0.0, 1.0)


def test_stalled_motors_freeze_odometry_but_not_its_sequence() -> None:
    base = base_of()
    keep_telling(base, AHEAD, 2.0)
    base.stalled = True
    pose, sequence = base.odometry, base.sequence
    keep_telling(base, AHEAD, 1.0)
    assert base.odometry == pose
    assert base.sequence == sequence + 50


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_no_number_is_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        base_of().command(Velocity(0.0, bad, 0.0), 0.0)


speed = st.floats(-5.0, 5.0)


@FAST
@given(st.lists(st.tuples(speed, speed, speed, st.integers(0, 30)), max_size=12))
def test_whatever_was_commanded_it_keeps_its_limits_and_comes_to_rest(
    told: list[tuple[float, float, float, int]],
) -> None:
    base, d = base_of(), ROBOTINO
    for forward, left, turn, steps in told:
        base.command(Velocity(forward, left, turn), base.now_s)
        for _ in range(steps):
            before = base.velocity
            base.step(STEP_S)
            now = base.velocity
            assert max(abs(now.forward_m_s), abs(now.left_m_s)) <= d.max_speed_m_s
            assert abs(now.turn_rad_s) <= d.max_turn_rad_s
            assert abs(now.forward_m_s - before.forward_m_s) <= d.decel_m_s2 * STEP_S + 1e-9
    base.run_until(base.now_s + 4.0)
    assert base.velocity == STANDSTILL
