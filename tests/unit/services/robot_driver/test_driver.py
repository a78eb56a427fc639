"""The driver and its limits, with a robot that does what the test tells it to (A9, A21, E11)."""

from __future__ import annotations

import math
from typing import Any

import msgpack
import numpy as np
import pytest
from builders import command
from hypothesis import given, settings
from hypothesis import strategies as st

from services.robot_driver.driver import Driver
from services.robot_driver.motion_control import action_velocity
from services.robot_driver.robot import STANDSTILL, Felt, Pose, Robot, Sensed, Velocity
from services.robot_driver.safety import Safety
from shared.config import Config, RobotConfig
from shared.messages import Action

FAST = settings(deadline=None, max_examples=80, derandomize=True)
LIFE = "a" * 12
CONFIG = Config(robot=RobotConfig(id="robot1", turn_rad_s=1.0, deadman_s=0.6))


class ScriptedRobot(Robot):
    """Stands on a plane; `contacts` tells, for each stretch of time to come, whether it bumps."""

    def __init__(self) -> None:
        self.contacts: list[bool] = []
        self.velocity = STANDSTILL
        self.told: list[Velocity] = []
        self.x_m = self.heading_rad = self.time_s = 0.0

    def sense(self) -> Sensed:
        image = np.full((50, 75), int(self.time_s * 4) % 256, np.uint8)
        return Sensed(Pose(self.x_m, 0.0, self.heading_rad), False, image)

    def feel(self) -> Felt:
        return Felt(Pose(self.x_m, 0.0, self.heading_rad), contact=False)

    def drive(self, velocity: Velocity) -> None:
        self.velocity = velocity
        self.told.append(velocity)

    def run(self, duration_s: float, *, stop_on_contact: bool) -> bool:
        contact = self.contacts.pop(0) if self.contacts else False
        if contact and stop_on_contact:
            self.velocity = STANDSTILL
        self.x_m += self.velocity.forward_m_s * duration_s
        self.heading_rad += self.velocity.turn_rad_s * duration_s
        self.time_s += duration_s
        return contact

    def now_s(self) -> float:
        return self.time_s

    def state(self) -> dict[str, float | int | str]:
        return {"x_m": self.x_m, "heading_rad": self.heading_rad, "time_s": self.time_s}

    def restore(self, state: dict[str, Any]) -> None:
        self.x_m, self.heading_rad, self.time_s = (
            state["x_m"],
            state["heading_rad"],
            state["time_s"],
        )

    def close(self) -> None:
        self.velocity = STANDSTILL


def make_driver(**robot: Any) -> tuple[Driver, ScriptedRobot]:
    config = CONFIG.model_copy(update={"robot": CONFIG.robot.model_copy(update=robot)})
    scripted = ScriptedRobot()
    return Driver(config, scripted, LIFE), scripted


def answer(sequence: int, attempt: int = 0, life: str = LIFE) -> Action:
    return Action(
        robot="robot1",
        actor_life="b" * 12,
        robot_life=life,
        sequence=sequence,
        attempt=attempt,
        action=0,
        by="network",
        values=(0.0, 0.0, 0.0),
        weights_version=1,
    )


# ------------------------------------------------------------------------- actions


def test_actions_drive_forward_and_turn_left_or_right() -> None:
    speed, turn = CONFIG.robot.speed_m_s, CONFIG.robot.turn_rad_s
    assert action_velocity(CONFIG, 0) == Velocity(speed, 0.0, 0.0)
    assert action_velocity(CONFIG, 1) == Velocity(speed, 0.0, turn)
    assert action_velocity(CONFIG, 2) == Velocity(speed, 0.0, -turn)


def test_each_executed_action_counts_one_and_lasts_one_period() -> None:
    driver, robot = make_driver()
    for sequence in range(5):
        observation = driver.observe()
        assert (observation.sequence, observation.attempt, observation.bump) == (sequence, 0, False)
        assert observation.life == LIFE
        assert observation.robot == "robot1"
        assert observation.x_m == pytest.approx(sequence * 0.6 * 0.25)
        assert observation.stamp_s == pytest.approx(sequence * 0.25)
        driver.execute(sequence % 3)
    assert driver.report(0).state == "waiting"
    assert robot.time_s == pytest.approx(5 * 0.25)


def test_an_observation_shows_what_the_robot_sensed() -> None:
    driver, robot = make_driver()
    robot.heading_rad, robot.time_s = 0.3, 1.0
    observation = driver.observe()
    assert observation.image == bytes([4]) * 3750
    assert (observation.heading_rad, observation.period_s, observation.world) == (0.3, 0.25, "plus")


def test_only_the_answer_to_the_newest_observation_counts() -> None:
    driver, _ = make_driver()
    driver.execute(0)
    driver.look_again("")
    assert driver.answers(answer(1, attempt=1))
    wrong = [answer(0), answer(1), answer(1, 2), answer(2), answer(1, 1, life="c" * 12)]
    assert not any(driver.answers(action) for action in wrong)
    assert driver.refused_actions == len(wrong)


# ------------------------------------------------------------------------- bumps


def test_a_bump_stops_the_robot_is_flagged_and_recovered_from() -> None:
    driver, robot = make_driver()
    robot.contacts = [False, True]
    driver.execute(0)
    told = len(robot.told)
    driver.execute(1)
    assert robot.told[told + 1] == STANDSTILL  # right after the action's own velocity
    assert robot.velocity == STANDSTILL
    assert robot.told[told + 2].forward_m_s < 0.0  # retreats by driving
    observation = driver.observe()
    assert (observation.bump, observation.sequence, observation.interruption) == (True, 2, "")
    assert (driver.bumps, driver.recoveries) == (1, 1)
    driver.execute(0)
    assert not driver.observe().bump


def test_recovery_headings_are_drawn_by_sequence() -> None:
    headings = []
    for start in (0, 1, 1):
        driver, robot = make_driver()
        driver.sequence = start
        robot.contacts = [True]
        driver.execute(0)
        headings.append(math.remainder(robot.heading_rad, 2 * math.pi))
    assert headings[1] == headings[2] != headings[0]


def test_without_recovery_the_robot_keeps_pressing_and_only_the_flag_tells() -> None:
    driver, robot = make_driver(recovery="none")
    robot.contacts = [True, True]
    driver.execute(0)
    assert robot.velocity == action_velocity(CONFIG, 0)
    assert driver.observe().bump
    driver.execute(1)
    assert (driver.bumps, driver.recoveries, driver.sequence) == (2, 0, 2)
    assert STANDSTILL not in robot.told


def test_contact_before_an_action_began_keeps_the_number() -> None:
    driver, robot = make_driver(timing="realtime")
    driver.execute(0)
    robot.contacts = [True]
    bump = driver.advance(0.02)
    driver.settle(bump, executed=False)
    observation = driver.observe()
    assert (observation.sequence, observation.attempt, observation.bump) == (1, 1, True)


# ------------------------------------------------------------------------- limits

number = st.floats(allow_nan=True, allow_infinity=True)


@FAST
@given(number, number, number, st.floats(0.1, 2.0), st.floats(0.1, 3.0))
def test_no_wish_gets_beyond_the_limits(
    forward: float, left: float, turn: float, max_speed: float, max_turn: float
) -> None:
    config = RobotConfig(
        speed_m_s=0.1, turn_rad_s=0.1, max_speed_m_s=max_speed, max_turn_rad_s=max_turn
    )
    safety, wanted = Safety(config), Velocity(forward, left, turn)
    allowed = safety.allow(wanted, 0.0)
    parts = (allowed.forward_m_s, allowed.left_m_s, allowed.turn_rad_s)
    assert all(math.isfinite(part) for part in parts)
    assert math.hypot(allowed.forward_m_s, allowed.left_m_s) <= max_speed * (1 + 1e-9)
    assert abs(allowed.turn_rad_s) <= max_turn
    if not all(math.isfinite(part) for part in (forward, left, turn)):
        assert allowed == STANDSTILL
    elif math.hypot(forward, left) <= max_speed and abs(turn) <= max_turn:
        assert (allowed, safety.clamped) == (wanted, 0)
    else:
        assert safety.clamped == 1
        assert allowed.forward_m_s * forward >= 0.0
        assert allowed.left_m_s * left >= 0.0
        assert allowed.turn_rad_s * turn >= 0.0


def test_a_clamped_wish_keeps_its_direction() -> None:
    safety = Safety(RobotConfig(max_speed_m_s=1.0))
    allowed = safety.allow(Velocity(3.0, -4.0, 9.0), 0.0)
    assert (allowed.forward_m_s, allowed.left_m_s) == (pytest.approx(0.6), pytest.approx(-0.8))
    assert allowed.turn_rad_s == 1.5


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("part", [0, 1, 2])
def test_a_wish_that_is_not_finite_is_refused_and_refreshes_nothing(bad: float, part: int) -> None:
    safety, parts = Safety(RobotConfig()), [0.1, 0.0, 0.1]
    parts[part] = bad
    assert safety.allow(Velocity(*parts), 5.0) == STANDSTILL
    assert safety.expired(5.0)


def test_the_deadman_expires_after_its_time_and_not_at_it() -> None:
    safety = Safety(RobotConfig(deadman_s=0.6))
    assert safety.expired(0.0)  # never yet told
    safety.allow(Velocity(0.1, 0.0, 0.0), 10.0)
    assert not safety.expired(10.6)
    assert safety.expired(10.601)


def test_without_a_fresh_action_the_robot_stops_once_and_it_is_counted() -> None:
    driver, robot = make_driver(timing="realtime")
    driver.start(0)
    for _ in range(30):
        driver.advance(0.02)
    assert robot.velocity.moving
    assert driver.safety.deadman_stops == 0
    driver.advance(0.02)
    assert robot.velocity == STANDSTILL
    for _ in range(50):
        driver.advance(0.02)
    assert driver.safety.deadman_stops == driver.report(0).deadman_stops == 1
    driver.start(1)
    driver.advance(0.02)
    assert robot.velocity.moving


def test_lockstep_actions_never_meet_the_deadman() -> None:
    driver, _ = make_driver(deadman_s=0.25)
    for _ in range(4):
        driver.execute(0)
    assert driver.safety.deadman_stops == 0


# ------------------------------------------------------------------------- operators


def test_an_emergency_stop_is_latched_until_cleared() -> None:
    driver, robot = make_driver(timing="realtime")
    driver.start(0)
    command(driver, "estop")
    assert robot.velocity == STANDSTILL
    assert driver.report(0).state == "estop"
    for order in ("resume", "pause", "resume", "estop"):
        command(driver, order)
        driver.start(0)
        assert robot.velocity == STANDSTILL
        assert driver.safety.estop
    command(driver, "clear")
    assert not driver.safety.halted
    driver.start(0)
    assert robot.velocity.moving


def test_the_observation_after_a_cleared_stop_tells_of_it_once() -> None:
    driver, _ = make_driver()
    driver.execute(0)
    command(driver, "estop")
    command(driver, "clear")
    observation = driver.observe()
    assert (observation.sequence, observation.attempt, observation.interruption) == (1, 1, "estop")
    driver.execute(0)
    assert driver.observe().interruption == ""


def test_clear_without_a_stop_changes_nothing() -> None:
    driver, _ = make_driver()
    command(driver, "clear")
    assert (driver.attempt, driver.observe().interruption) == (0, "")


@pytest.mark.parametrize(("timing", "told"), [("lockstep", ""), ("realtime", "pause")])
def test_a_pause_interrupts_only_where_time_goes_on(timing: str, told: str) -> None:
    driver, robot = make_driver(timing=timing)
    driver.start(0)
    command(driver, "pause")
    assert robot.velocity == STANDSTILL
    assert driver.report(0).state == "paused"
    command(driver, "resume")
    assert driver.observe().interruption == told
    command(driver, "resume")  # a second one changes nothing
    assert driver.attempt == int(timing == "realtime")


def test_clear_does_not_end_a_pause() -> None:
    driver, robot = make_driver()
    command(driver, "pause")
    command(driver, "estop")
    command(driver, "clear")
    driver.start(0)
    assert robot.velocity == STANDSTILL


def test_an_interruption_is_not_forgotten_by_looking_again() -> None:
    driver, _ = make_driver(timing="realtime")
    driver.look_again("late")
    driver.look_again("")
    assert driver.observe().interruption == "late"
    driver.look_again("estop")
    assert (driver.observe().interruption, driver.attempt) == ("estop", 3)


def test_an_emergency_stop_after_a_bump_hides_no_bump() -> None:
    """E42: the observation after it tells both, under the number after the action."""
    driver, robot = make_driver(timing="realtime")
    robot.contacts = [True]
    driver.start(0)
    driver.settle(driver.advance(0.02))
    for order in ("estop", "clear"):
        command(driver, order)
    seen = driver.observe()
    assert (seen.sequence, seen.bump, seen.interruption) == (1, True, "estop")


def test_contact_of_a_motion_stays_apart_from_an_actions_bump() -> None:
    driver, robot = make_driver(timing="realtime")
    assert driver.start_motion("turn-left")
    robot.contacts = [True]
    driver.settle(driver.advance(0.02))
    driver.look_again("late")
    seen = driver.observe()
    assert (seen.sequence, seen.bump, seen.interruption) == (0, True, "moved")


def test_halt_during_an_action_stops_it() -> None:
    driver, robot = make_driver(timing="realtime")
    driver.start(0)
    driver.safety.estop = True
    driver.advance(0.02)
    assert robot.velocity == STANDSTILL
    assert driver.safety.deadman_stops == 0


# ------------------------------------------------------------------------- state


def test_a_restored_driver_continues_where_the_saved_one_stood() -> None:
    observations = []
    for restart in (False, True):
        driver, robot = make_driver()
        robot.contacts = [False, True, False]
        for _ in range(3):
            driver.execute(1)
        driver.look_again("late")
        if restart:
            saved = msgpack.unpackb(msgpack.packb(driver.saved()))
            driver, robot = make_driver()
            driver.life = "d" * 12
            driver.restore(saved)
            assert driver.observe().earlier == (LIFE,)
            driver.earlier, driver.life = (), LIFE
        for action in (0, 2):
            observations.append(driver.observe())
            driver.execute(action)
        report = driver.report(0)
        observations.append(report)
    assert observations[:3] == observations[3:]


def test_an_observation_tells_what_was_executed_and_who_sent_it() -> None:
    driver, _ = make_driver(timing="realtime")
    assert (driver.observe().action, driver.observe().actor_life) == (None, "")
    driver.execute(2, "b" * 12)
    driver.start(0, "c" * 12)
    driver.look_again("late")  # it was stopped before it ended: it does not count
    seen = driver.observe()
    assert (seen.sequence, seen.action, seen.actor_life) == (1, 2, "b" * 12)


@pytest.mark.parametrize("missing", ["robot", "changes", "lives"])
def test_a_saved_state_without_its_parts_is_refused(missing: str) -> None:
    driver, _ = make_driver()
    saved = driver.saved()
    del saved[missing]
    with pytest.raises(KeyError, match=missing):
        make_driver()[0].restore(saved)


def test_the_report_counts_everything() -> None:
    driver, robot = make_driver(max_speed_m_s=0.3)
    robot.contacts = [True]
    driver.execute(0)
    driver.answers(answer(9))
    driver.late_actions, driver.resent_observations = 3, 4
    report = driver.report(undecodable=5)
    assert (report.bumps, report.recoveries, report.sequence) == (1, 1, 1)
    assert (report.refused_actions, report.late_actions, report.resent_observations) == (1, 3, 4)
    assert (report.undecodable, report.laps_left, report.laps_right) == (5, 0, 0)
    assert report.clamped >= 1
