"""What may be sent to a real robot, whatever its driver does: lease, contact, limits, zeros."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.robot_driver.real.gate import PRESSED_RECOVERIES, ZEROS, Gate
from services.robot_driver.robot import STANDSTILL, RobotFault, Velocity
from shared.config import RobotConfig

FAST = settings(deadline=None, max_examples=100, derandomize=True)
CONFIG = RobotConfig(period_s=0.2, deadman_s=0.3, speed_m_s=0.2, recovery_speed_m_s=0.1)
AHEAD = Velocity(0.2, 0.0, 0.3)
SLOWLY = Velocity(-0.1, 0.0, 0.0)
TICK_S = 0.01


def gate_of() -> Gate:
    return Gate(CONFIG)


def sent(gate: Gate, start_s: float, duration_s: float) -> list[tuple[float, Velocity]]:
    """What leaves while nobody calls."""
    out = []
    for tick in range(round(duration_s / TICK_S)):
        now_s = start_s + tick * TICK_S
        if (velocity := gate.due(now_s)) is not None:
            gate.sent(velocity, now_s, arrived=True)
            out.append((now_s, velocity))
    return out


def test_at_first_it_tells_the_robot_to_stop_and_then_is_silent() -> None:
    assert [velocity for _, velocity in sent(gate_of(), 0.0, 5.0)] == [STANDSTILL] * ZEROS


def test_motion_is_sent_every_command_period_while_it_is_renewed() -> None:
    gate = gate_of()
    gate.drive(AHEAD, 0.0)
    times = []
    for tick in range(100):
        gate.renew(tick * TICK_S, regardless=False)
        times += [at_s for at_s, velocity in sent(gate, tick * TICK_S, TICK_S) if velocity == AHEAD]
    gaps = [b - a for a, b in itertools.pairwise(times)]
    assert times[0] == 0.0
    assert min(gaps) >= 0.1 - 1e-9
    assert max(gaps) <= 0.1 + TICK_S + 1e-9


def test_a_driver_that_hangs_loses_its_lease_for_good() -> None:
    gate = gate_of()
    gate.drive(AHEAD, 0.0)
    out = sent(gate, 0.0, 2.0)
    stops = [at_s for at_s, velocity in out if velocity == STANDSTILL]
    assert len(stops) == ZEROS
    assert stops[0] <= CONFIG.period_s + 2 * TICK_S
    assert gate.lease_stops == 1
    gate.renew(2.0, regardless=False)
    assert gate.lapsed
    assert gate.in_force(2.0) == STANDSTILL
    gate.drive(AHEAD, 2.1)
    assert gate.in_force(2.1) == AHEAD
    assert not gate.lapsed


def test_contact_stops_it_until_the_driver_has_looked_and_the_bumper_is_free() -> None:
    gate = gate_of()
    gate.drive(AHEAD, 0.0)
    gate.feel(True, 0.0)
    assert gate.in_force(0.0) == STANDSTILL
    gate.feel(False, 0.0)  # so short a contact that the driver has not seen it
    assert gate.in_force(0.0) == STANDSTILL
    assert gate.handled()
    assert not gate.handled()
    assert gate.in_force(0.0) == AHEAD
    gate.feel(True, 0.0)
    assert gate.handled()
    gate.drive(AHEAD, 0.1)
    assert gate.in_force(0.1) == STANDSTILL


def test_somebody_who_touches_a_standing_robot_is_no_bump() -> None:
    gate = gate_of()
    gate.feel(True, 0.0)
    assert not gate.handled()
    gate.feel(False, 0.0)
    assert not gate.handled()


@pytest.mark.parametrize(("after_s", "bump"), [(0.1, True), (CONFIG.hardware.rest_s + 0.2, False)])
def test_contact_counts_while_the_robot_coasts_after_a_stop(after_s: float, bump: bool) -> None:
    gate = gate_of()
    gate.drive(AHEAD, 0.0)
    sent(gate, 0.0, 0.1)
    gate.drive(STANDSTILL, 0.1)
    sent(gate, 0.1, 0.1)
    gate.feel(True, 0.1 + after_s)
    assert gate.handled() is bump


def test_a_recovery_that_ends_pressed_is_no_new_contact() -> None:
    gate = gate_of()
    gate.feel(True, 0.0)
    gate.drive(SLOWLY, 0.0)
    gate.renew(0.0, regardless=True)
    sent(gate, 0.0, 0.1)
    gate.drive(STANDSTILL, 0.1)
    gate.renew(0.1, regardless=True)  # the rest
    sent(gate, 0.1, 0.1)
    gate.renew(0.2, regardless=False)
    gate.feel(True, 0.21)
    assert not gate.handled()


def test_recovery_moves_a_pressed_robot_slowly_only() -> None:
    gate = gate_of()
    gate.feel(True, 0.0)
    gate.drive(SLOWLY, 0.0)
    assert gate.in_force(0.0) == STANDSTILL
    gate.renew(0.0, regardless=True)
    assert gate.in_force(0.0) == SLOWLY
    gate.drive(AHEAD, 0.1)
    gate.renew(0.1, regardless=True)
    assert gate.in_force(0.1) == STANDSTILL
    gate.drive(STANDSTILL, 0.2)
    gate.drive(SLOWLY, 0.2)
    assert gate.in_force(0.2) == STANDSTILL  # it must be meant anew


def test_recovery_ends_where_the_bumper_never_lets_go() -> None:
    gate = gate_of()
    gate.feel(True, 0.0)
    now_s, way_m = 0.0, 0.0
    gate.drive(SLOWLY, now_s)
    while not gate.stuck and now_s < 100.0:
        gate.renew(now_s, regardless=True)
        way_m += sum(TICK_S * 0.1 for _ in [gate.in_force(now_s)] if _.moving)
        sent(gate, now_s, TICK_S)
        now_s += TICK_S
    allowed_m = PRESSED_RECOVERIES * CONFIG.recovery_distance_m
    assert way_m == pytest.approx(allowed_m, abs=0.01)
    assert gate.in_force(now_s) == STANDSTILL
    gate.feel(False, 0.0)
    assert not gate.stuck


def test_a_problem_is_stronger_than_any_wish() -> None:
    gate = gate_of()
    gate.drive(AHEAD, 0.0)
    gate.problem = "camera: stale"
    gate.renew(0.0, regardless=True)
    assert gate.in_force(0.0) == STANDSTILL


@pytest.mark.parametrize("lost", [0, 3])
def test_a_robot_is_stopped_often_enough_before_it_drives_back(lost: int) -> None:
    gate = gate_of()
    gate.drive(AHEAD, 0.0)
    sent(gate, 0.0, 0.05)
    out: list[Velocity] = []
    for tick in range(5, 60):
        now_s = tick * TICK_S
        gate.drive(SLOWLY, now_s)
        gate.renew(now_s, regardless=True)
        if (velocity := gate.due(now_s)) is not None:
            gate.sent(velocity, now_s, arrived=len(out) >= lost)
            out.append(velocity)
    assert out[: ZEROS + lost + 1] == [STANDSTILL] * (ZEROS + lost) + [SLOWLY]
    assert set(out[ZEROS + lost :]) == {SLOWLY}


def test_stops_that_did_not_arrive_are_sent_until_enough_did() -> None:
    gate, tries, arrived = gate_of(), 0, 0
    for tick in range(300):
        now_s = tick * TICK_S
        if (velocity := gate.due(now_s)) is not None:
            tries += 1
            arrived += int(tries > 8)
            gate.sent(velocity, now_s, arrived=tries > 8)
    assert (tries, arrived) == (8 + ZEROS, ZEROS)
    assert gate.silent


@pytest.mark.parametrize(
    "bad",
    [
        Velocity(math.nan, 0.0, 0.0),
        Velocity(0.0, math.inf, 0.0),
        Velocity(0.0, 0.0, math.nan),
        Velocity(0.9, 0.0, 0.0),
        Velocity(0.7, 0.7, 0.0),
        Velocity(0.0, 0.0, 1.6),
    ],
)
def test_what_is_no_velocity_of_this_robot_is_refused_and_stops_it(bad: Velocity) -> None:
    gate = gate_of()
    gate.drive(AHEAD, 0.0)
    with pytest.raises(RobotFault, match="within the limits"):
        gate.drive(bad, 0.1)
    assert gate.in_force(0.1) == STANDSTILL


steps = st.one_of(
    st.tuples(st.just("drive"), st.sampled_from([AHEAD, SLOWLY, STANDSTILL])),
    st.tuples(st.just("renew"), st.booleans()),
    st.tuples(st.just("feel"), st.booleans()),
    st.tuples(st.just("problem"), st.booleans()),
    st.tuples(st.just("handled"), st.none()),
    st.tuples(st.just("wait"), st.floats(0.0, 0.5)),
)


@FAST
@given(st.lists(steps, max_size=60))
def test_no_history_lets_it_move_when_it_must_not(
    history: list[tuple[str, Velocity | bool | float | None]],
) -> None:
    gate, now_s = gate_of(), 0.0
    called_s = -math.inf
    last: Velocity | None = None
    for what, value in history:
        if what == "drive":
            assert isinstance(value, Velocity)
            gate.drive(value, now_s)
            called_s = now_s
        elif what == "renew":
            gate.renew(now_s, regardless=bool(value))
            called_s = now_s
        elif what == "feel":
            gate.feel(bool(value), now_s)
        elif what == "problem":
            gate.problem = "stale" if value else ""
        elif what == "handled":
            gate.handled()
        else:
            now_s += float(value or 0.0)
        velocity = gate.in_force(now_s)
        if velocity.moving:
            assert now_s - called_s <= gate.lease_s + 1e-9
            assert not gate.problem
            if gate.pressed:
                speed = math.hypot(velocity.forward_m_s, velocity.left_m_s)
                assert speed <= CONFIG.recovery_speed_m_s + 1e-9
        due = gate.due(now_s)
        if last is not None and velocity != last:
            assert due == velocity  # a change leaves at once
        if due is not None:
            gate.sent(due, now_s, arrived=True)
            last = due
