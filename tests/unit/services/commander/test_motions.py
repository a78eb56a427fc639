"""Motions that are no actions: turning on the spot, creeping, letting go of what was touched."""

from __future__ import annotations

import math

import numpy as np
import pytest
from builders import command, make_observation
from fakes import message
from forwarding import ForwardingRobot
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from services.commander.commander import refuse_others
from services.commander.drive import DriveTally
from services.robot_driver.driver import Driver
from services.robot_driver.motion_control import motion_velocity
from services.robot_driver.robot import STANDSTILL, Felt, Velocity
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import load_world
from shared.config import Config
from shared.errors import RobotTaken
from shared.facts import FORWARD_LEFT
from shared.keys import Peer
from shared.messages import Action, Motion, Observation
from shared.rl.spot_turns import SpotTurns

FAST = settings(deadline=None, max_examples=60, derandomize=True)
MOTIONS: list[Motion] = ["turn-left", "turn-right", "forward", "back"]


class Watched(ForwardingRobot):
    """A robot that notes its velocities; the rest is the simulated one's."""

    def __init__(self, config: Config) -> None:
        self.sim = SimRobot(config.robot, load_world("minus"), 1)
        super().__init__(self.sim)
        self.told: list[Velocity] = []
        self.pressed = False

    def feel(self) -> Felt:
        felt = self.sim.feel()
        return Felt(felt.pose, contact=self.pressed or felt.contact)

    def drive(self, velocity: Velocity) -> None:
        self.told.append(velocity)
        self.sim.drive(velocity)


def make(**robot: object) -> tuple[Driver, Watched]:
    config = Config.model_validate({"robot": {"world": "minus", **robot}})
    watched = Watched(config)
    return Driver(config, watched, "a" * 12), watched


def test_a_motion_is_no_action_and_says_that_the_robot_was_moved() -> None:
    driver, robot = make()
    driver.execute(0)
    before = driver.observe()
    for attempt, motion in enumerate(MOTIONS, 1):
        driver.move(motion)
        seen = driver.observe()
        assert (seen.sequence, seen.attempt) == (before.sequence, attempt)
        assert (seen.interruption, seen.bump) == ("moved", False)
    driver.execute(0)
    assert driver.observe().interruption == ""
    assert driver.sequence == before.sequence + 1
    robot.close()


def test_turns_stay_on_the_spot_and_creeping_is_slow() -> None:
    driver, robot = make()
    period_s, turn = driver._config.robot.period_s, driver._config.robot.turn_rad_s
    start = robot.sim.pose
    driver.move("turn-left")
    assert robot.sim.pose.heading_rad - start.heading_rad == pytest.approx(turn * period_s)
    assert (robot.sim.pose.x_m, robot.sim.pose.y_m) == pytest.approx((start.x_m, start.y_m))
    driver.move("turn-right")
    driver.move("forward")
    driver.move("back")
    there = (robot.sim.pose.x_m, robot.sim.pose.y_m, robot.sim.pose.heading_rad)
    assert there == pytest.approx((start.x_m, start.y_m, start.heading_rad))
    assert all(abs(v.forward_m_s) <= 0.2 and v.left_m_s == 0.0 for v in robot.told)
    robot.close()


@FAST
@given(st.lists(st.sampled_from(MOTIONS), max_size=60), st.sampled_from(["back-off", "none"]))
def test_no_sequence_of_motions_leaves_the_robot_pressed_against_a_wall(
    motions: list[Motion], recovery: str
) -> None:
    driver, robot = make(recovery=recovery, max_speed_m_s=0.61, recovery_speed_m_s=0.5)
    for motion in motions:
        driver.move(motion)
        assert not robot.sim.contact
        assert max((abs(v.forward_m_s) for v in robot.told), default=0.0) <= 0.5
    assert driver.recoveries == 0
    robot.close()


@pytest.mark.parametrize(("motion", "away"), [("forward", -1.0), ("back", 1.0)])
def test_contact_stops_a_motion_and_the_robot_lets_go_the_other_way(
    motion: Motion, away: float
) -> None:
    driver, robot = make(recovery="none")
    for _ in range(400):
        driver.move(motion)
        if driver.bumps:
            break
    seen = driver.observe()
    assert (seen.bump, seen.interruption) == (True, "moved")
    moving = [v for v in robot.told if v.moving]
    assert math.copysign(1.0, moving[-1].forward_m_s) == away
    assert robot.told[-1] == STANDSTILL
    assert not robot.sim.contact
    robot.close()


def test_no_motion_begins_while_the_bumper_is_pressed() -> None:
    driver, robot = make()
    robot.pressed = True
    for motion in MOTIONS:
        driver.move(motion)
    assert not any(v.moving for v in robot.told)
    assert driver.observe().attempt == len(MOTIONS)
    robot.close()


def test_a_stopped_robot_makes_no_motion() -> None:
    driver, robot = make()
    command(driver, "estop")
    start = robot.sim.pose
    driver.move("forward")
    assert robot.sim.pose == start
    robot.close()


def test_motions_are_cut_to_the_limits() -> None:
    driver, robot = make(speed_m_s=0.1, max_speed_m_s=0.1, recovery_speed_m_s=0.5)
    assert motion_velocity(driver._config, "back") == Velocity(-0.5, 0.0, 0.0)
    driver.move("back")
    assert robot.told[0] == Velocity(-0.1, 0.0, 0.0)
    assert driver.safety.clamped == 1
    robot.close()


def test_an_action_and_a_motion_exclude_each_other() -> None:
    with pytest.raises(ValidationError, match="expected no action beside it"):
        message(Action, action=1, motion="back")


# ------------------------------------------------------------------------- turning on the spot


@FAST
@given(
    st.lists(st.tuples(*[st.sampled_from([-0.5, -0.1, 0.0, 0.5])] * 3), max_size=60),
    st.floats(0.2, 3.0),
)
def test_the_robot_turns_one_way_while_nothing_good_is_predicted(
    predicted: list[tuple[float, float, float]], turn_rad: float
) -> None:
    turns, side, turned = SpotTurns(turn_rad), "", 0
    for values in predicted:
        best = int(np.argmax(values))
        decided = turns.decide(np.array(values, np.float32), best)
        if max(values) >= 0.0:
            assert decided == ""
        elif decided:
            assert decided == (side or ("left" if best == FORWARD_LEFT else "right"))
        else:
            assert turned * turn_rad >= math.radians(720.0) - turn_rad
        side, turned = decided, turned + 1 if decided else 0
        assert turned * turn_rad <= math.radians(720.0) + turn_rad


# ------------------------------------------------------------------------- commanding


@pytest.mark.parametrize(
    ("service", "ident", "life", "taken"),
    [
        ("actor", "main", "b", True),
        ("actor", "robot1", "b", True),
        ("actor", "robot2", "b", False),
        ("actor", "robot1", "a", False),
        ("driver", "robot1", "b", False),
    ],
)
def test_there_is_one_commander_at_a_time(service: str, ident: str, life: str, taken: bool) -> None:
    peers = [Peer(service, ident, life * 12, "1", "0" * 16)]
    if not taken:
        refuse_others(peers, "robot1", "a" * 12)
        return
    with pytest.raises(RobotTaken, match="end it first"):
        refuse_others(peers, "robot1", "a" * 12)


def test_the_log_of_a_drive_counts_actions_turns_bumps_and_metres() -> None:
    log = DriveTally()

    def see(sequence: int, ask: bool = True, **fields: object) -> None:
        log.see(make_observation(sequence, **fields))
        if ask:
            log.ask()

    see(5)
    see(6, x_m=0.5)
    see(6, x_m=0.5, attempt=1, interruption="moved")
    see(6, x_m=0.5, attempt=2, interruption="late")
    see(7, x_m=0.5, y_m=1.0, bump=True)
    see(7, x_m=0.5, y_m=1.0, bump=True, attempt=1, interruption="late", ask=False)
    see(0, x_m=90.0, life="c" * 12)
    see(1, x_m=91.0, life="c" * 12, world="minus")
    assert str(log) == "2 actions, 1 turns on the spot, 1 bumps, 1.5 m"
    assert isinstance(log._before, Observation)
