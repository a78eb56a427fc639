"""A real robot behind a link that does what the test tells it to."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest
from fake_link import FakeLink, config_of

from benchmarks.waiting import wait_until
from services.robot_driver.driver import Driver
from services.robot_driver.kinds import make_robot
from services.robot_driver.motion_control import action_velocity
from services.robot_driver.real import hardware
from services.robot_driver.real.gate import ZEROS
from services.robot_driver.real.hardware import HardwareRobot
from services.robot_driver.real.link import Battery
from services.robot_driver.robot import STANDSTILL, NotReady, Pose, Velocity
from shared.config import Config, RobotConfig
from shared.errors import ConfigError, RobotMissing
from shared.keys import ROBOT_STATE
from shared.messages import MAX_FAULTS

AHEAD = Velocity(0.2, 0.0, 0.0)


@pytest.fixture
def link() -> FakeLink:
    return FakeLink()


@pytest.fixture
def robot(link: FakeLink) -> Iterator[HardwareRobot]:
    one = HardwareRobot(config_of().robot, link)
    yield one
    one.close()


def moves(link: FakeLink, velocity: Velocity = AHEAD) -> None:
    wait_until(lambda: link.told and link.told[-1] == velocity, 20, "the velocity is sent")


def stops(link: FakeLink) -> None:
    wait_until(lambda: link.told[-ZEROS:] == [STANDSTILL] * ZEROS, 20, "stops are sent")


def fit(robot: HardwareRobot) -> bool:
    try:
        robot.sense()
    except NotReady:
        return False
    return True


def test_it_senses_what_the_link_told(robot: HardwareRobot) -> None:
    sensed = robot.sense()
    assert sensed.pose == Pose(0.0, 0.0, 0.0)
    assert not sensed.contact
    assert sensed.image.shape == (50, 75)
    assert robot.state() == {}


@pytest.mark.parametrize(
    ("spoil", "mend", "reason"),
    [
        (lambda k: k.held.add("camera"), lambda k: k.held.clear(), "camera: nothing new"),
        (lambda k: k.held.add("odometry"), lambda k: k.held.clear(), "odometry: nothing new"),
        (lambda k: k.held.add("bumper"), lambda k: k.held.clear(), "bumper: nothing new"),
        (lambda k: setattr(k, "low", True), lambda k: setattr(k, "low", False), "battery: low"),
        (
            lambda k: setattr(k, "hindrance", "nobody listens"),
            lambda k: setattr(k, "hindrance", ""),
            "nobody listens",
        ),
        (
            lambda k: setattr(k, "refuses", True),
            lambda k: setattr(k, "refuses", False),
            "command: does not get through: command: status 503",
        ),
    ],
)
def test_it_stands_while_it_is_not_fit_and_can_go_on_after(
    spoil: Any, mend: Any, reason: str, robot: HardwareRobot, link: FakeLink
) -> None:
    robot.drive(AHEAD)
    moves(link)
    spoil(link)
    with pytest.raises(NotReady, match=reason):
        robot.run(20.0, stop_on_contact=True)
    with pytest.raises(NotReady, match=reason):
        robot.sense()
    with pytest.raises(NotReady, match=reason):
        robot.drive(AHEAD)
    robot.drive(STANDSTILL)
    mend(link)
    stops(link)

    wait_until(lambda: fit(robot), 20, "it is fit again")
    robot.drive(AHEAD)
    moves(link)


@pytest.mark.parametrize("sensor", ["camera", "odometry", "bumper"])
def test_a_reading_of_every_sensor_grows_old(sensor: str, link: FakeLink) -> None:
    limits = config_of().robot.hardware
    patient = {f"{name}_stale_s": 5.0 for name in ("camera", "odometry", "bumper")}
    ages = limits.model_copy(update={**patient, f"{sensor}_stale_s": 0.5})
    config, ahead_s = config_of().robot.model_copy(update={"hardware": ages}), 0.0
    robot = HardwareRobot(config, link, lambda: time.monotonic() + ahead_s)
    ahead_s = 0.6
    with pytest.raises(NotReady, match=f"{sensor}: nothing new for more than 0.5 s"):
        robot.sense()
    robot.close()


def test_it_stands_even_if_the_driver_hangs_while_a_sensor_fails(
    robot: HardwareRobot, link: FakeLink
) -> None:
    robot.drive(AHEAD)
    moves(link)
    link.held.add("camera")
    stops(link)


def test_contact_stops_it_at_once_and_is_told_even_if_it_is_over(
    robot: HardwareRobot, link: FakeLink
) -> None:
    robot.drive(AHEAD)
    moves(link)
    link.pressed = True
    stops(link)
    link.pressed = False
    wait_until(lambda: not robot.feel().contact, 20, "the bumper is free")
    assert robot.run(0.02, stop_on_contact=True)
    assert not robot.run(0.02, stop_on_contact=True)


def test_a_driver_that_hung_is_told_so(link: FakeLink) -> None:
    robot = HardwareRobot(config_of(period_s=0.1, deadman_s=0.1).robot, link)
    robot.drive(AHEAD)
    stops(link)
    with pytest.raises(NotReady, match="hung"):
        robot.run(0.02, stop_on_contact=True)
    assert robot.faults["command: lease expired"] == 1
    robot.close()


def test_closing_sends_stops_and_lets_go_once(robot: HardwareRobot, link: FakeLink) -> None:
    send, late = link.send, []

    def noted(velocity: Velocity) -> None:
        if robot._closing:
            late.append(velocity)
        send(velocity)

    link.send = noted  # type: ignore[method-assign]
    robot.drive(AHEAD)
    moves(link)
    robot.close()
    robot.close()
    assert sum(velocity.moving for velocity in late) <= 1  # one may have been on its way
    assert link.told[-ZEROS:] == [STANDSTILL] * ZEROS
    assert link.closed == 1


def test_closing_does_not_wait_for_ever_where_nothing_gets_through(
    robot: HardwareRobot, link: FakeLink
) -> None:
    link.refuses = True
    robot.close()
    assert link.closed == 1


def test_a_robot_without_a_bumper_stands_and_says_why(
    link: FakeLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hardware, "READING_S", 0.1)
    link.held, link.bumper.note = {"bumper"}, "nobody publishes on bumper"
    robot = HardwareRobot(config_of().robot, link)
    with pytest.raises(NotReady, match=r"^bumper: no reading: nobody publishes on bumper$"):
        robot.sense()
    link.held.clear()
    wait_until(lambda: fit(robot), 20, "it is fit")
    link.held.add("bumper")
    link.bumper.void("lifted")
    with pytest.raises(NotReady, match=r"^bumper: no reading: lifted$"):
        robot.drive(AHEAD)
    robot.close()


def test_a_battery_is_low_good_or_unknown(robot: HardwareRobot, link: FakeLink) -> None:
    link._done.set()
    link._thread.join()
    now_s = robot.now_s()
    for low, age_s, known in (
        (None, 0.0, None),
        (False, 0.0, False),
        (False, 100.0, None),
        (True, 100.0, True),
        (None, 0.0, True),
        (False, 0.0, False),
    ):
        link.battery.put(Battery(low, None), now_s - age_s)
        assert robot.battery_low() is known
        assert robot.faults["battery: unknown"] == (known is None)
    link.battery.void("truncated")
    assert robot.battery_low() is None


@pytest.mark.parametrize("ordered", [True, False], ids=["stalled", "pushed"])
def test_a_robot_that_moves_otherwise_than_it_is_told_stands(
    ordered: bool, robot: HardwareRobot, link: FakeLink
) -> None:
    link.stalled = True
    if ordered:
        robot.drive(AHEAD)

    def goes_on() -> None:
        for step in range(1000):
            if not ordered:
                link.pose = Pose(1.0 + 0.01 * step, 2.0, 0.5)
            robot.run(0.02, stop_on_contact=True)

    with pytest.raises(NotReady, match="told to drive" if ordered else "nobody told it to"):
        goes_on()
    stops(link)


def test_an_address_where_nobody_is_ends_in_one_line() -> None:
    config = config_of(robotino={"address": "127.0.0.1:9"}, hardware={"open_timeout_s": 3.0})
    with pytest.raises(RobotMissing, match=r"^driver: robot: no answer from .*: no connection"):
        make_robot(config)


def test_an_address_that_cannot_be_one_is_a_wrong_configuration() -> None:
    with pytest.raises(ConfigError, match=r"^robot\.robotino\.address: expected a port"):
        make_robot(config_of(robotino={"address": "robot:99999"}))


def test_a_blocked_driver_tells_why_interrupts_and_goes_on(
    robot: HardwareRobot, link: FakeLink
) -> None:
    driver = Driver(config_of(), robot, "a" * 12)
    driver.start(0)
    link.held.add("camera")
    with pytest.raises(NotReady) as caught:
        driver.advance(20.0)
    driver.block(str(caught.value))
    report = driver.report(0)
    assert (report.state, report.blocks) == ("blocked", 1)
    assert report.reason.startswith("camera: nothing new")
    assert not driver.fit()
    link.held.clear()
    wait_until(driver.fit, 20, "it is fit again")
    seen = driver.observe()
    assert (seen.sequence, seen.attempt, seen.interruption) == (0, 1, "blocked")
    assert driver.report(0).reason == ""
    driver.settle(False)
    assert driver.observe().interruption == ""


def test_a_bump_whose_recovery_is_cut_short_is_still_told(
    robot: HardwareRobot, link: FakeLink
) -> None:
    driver = Driver(config_of(), robot, "a" * 12)
    driver.start(0)
    link.pressed = True
    wait_until(lambda: driver.advance(0.02), 20, "contact")
    link.low = True
    driver.settle(True)
    assert driver.bumps == 1
    assert driver.recoveries == 0
    with pytest.raises(NotReady, match="battery"):
        driver.observe()
    link.low = link.pressed = False
    wait_until(driver.fit, 20, "it is fit again")
    seen = driver.observe()
    assert (seen.sequence, seen.bump) == (1, True)


def test_a_bump_as_it_becomes_unfit_is_counted_and_not_recovered_from(
    robot: HardwareRobot, link: FakeLink
) -> None:
    driver = Driver(config_of(), robot, "a" * 12)
    driver.start(0)
    moves(link, action_velocity(config_of(), 0))
    link.pressed = True
    stops(link)
    link.low = True
    wait_until(lambda: link.battery.get().value.low, 20, "a low battery")  # type: ignore[union-attr]
    with pytest.raises(NotReady, match="battery") as caught:
        driver.advance(20.0)
    assert caught.value.contact
    driver.block(str(caught.value), bump=caught.value.contact)
    assert (driver.bumps, driver.recoveries) == (1, 0)
    link.low = link.pressed = False
    wait_until(driver.fit, 20, "it is fit again")
    seen = driver.observe()
    assert (seen.sequence, seen.bump, seen.interruption) == (1, True, "blocked")  # E42


def test_a_restarted_driver_of_a_real_robot_tells_of_it(robot: HardwareRobot) -> None:
    driver = Driver(config_of(), robot, "a" * 12)
    saved = driver.saved()
    assert saved["kind"] == "robotino"
    driver.restore(saved)
    assert driver.observe().interruption == "restart"


def test_the_longest_report_fits_into_a_message(robot: HardwareRobot, link: FakeLink) -> None:
    from shared.codec import encode

    link.faults.update({f"{number:03d}: {'x' * 80}": 2**40 for number in range(40)})
    driver = Driver(config_of(), robot, "a" * 12)
    driver.reason = "y" * 500
    report = driver.report(0)
    assert len(report.faults) == MAX_FAULTS
    assert len(encode(report)) <= ROBOT_STATE.max_bytes


@pytest.mark.parametrize(
    ("robot", "complaint"),
    [
        ({"timing": "lockstep"}, "needs robot.timing 'realtime'"),
        ({"recovery": "none"}, "needs robot.recovery 'back-off'"),
    ],
)
def test_a_real_robot_needs_real_time_and_recovery(robot: dict[str, str], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        RobotConfig.model_validate({"kind": "robotino", "timing": "realtime", **robot})


def test_another_robot_may_take_part_in_a_run_but_not_at_another_pace() -> None:
    here, there = Config(), config_of()
    paced = here.model_copy(
        update={
            "robot": here.robot.model_copy(
                update={"timing": "realtime", "period_s": 2.0, "deadman_s": 3.0}
            )
        }
    )
    assert paced.fingerprint() == there.fingerprint()
    assert here.fingerprint() != there.fingerprint()


def test_a_driver_on_a_real_robot_needs_neither_torch_nor_pybullet() -> None:
    code = (
        "import sys\n"
        "import services.cli.main, services.robot_driver.service\n"
        "import services.robot_driver.real.hardware\n"
        "import services.robot_driver.real.robotino\n"
        "heavy = {'torch', 'pybullet', 'lmdb', 'safetensors', 'matplotlib', 'gymnasium'}\n"
        "sys.exit(', '.join(heavy & set(sys.modules)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
