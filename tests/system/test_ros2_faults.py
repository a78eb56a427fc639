"""The fault table of ROS 2 robots (H2): whatever fails, the robot stands, and goes on after.

Reaction times are measured by `benchmarks/ros2_reaction.py`; here the bound is generous.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest
from cluster import free_port

from benchmarks.ros2_rig import Ros2Rig
from services.robot_driver.emulation.dynamics import CREATE3, ROBOTINO
from services.robot_driver.robot import Velocity
from shared import settings
from shared.config import Config
from shared.messages import RobotState

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]
PERIOD_S = 0.4
SLACK_S = 1.0
"""Test machines stall."""


def configuration(preset: str, transport: str, name: str) -> Config:
    stale = [f"robot.hardware.{sensor}_stale_s=0.7" for sensor in ("camera", "odometry", "bumper")]
    return settings.load(
        preset,
        overrides=[
            f"run.name={name}",
            f"bus.endpoint=tcp/127.0.0.1:{free_port()}",
            "bus.heartbeat_s=0.2",
            f"robot.ros2.transport={transport}",
            f"robot.period_s={PERIOD_S}",
            "robot.deadman_s=0.6",
            "robot.hardware.open_timeout_s=60",
            *stale,
        ],
    )


@pytest.fixture(
    scope="module",
    params=[("robotino-ros2", "bridge"), ("turtlebot4", "rmw-zenoh")],
    ids=["robotino-bridge", "turtlebot4-rmw-zenoh"],
)
def rig(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Ros2Rig]:
    config = configuration(*request.param, name="faults")
    with Ros2Rig(config, tmp_path_factory.mktemp("faults")) as one:
        one.start("router", "driver", "actor")
        yield one


def allowed_s(rig: Ros2Rig) -> float:
    """Two control periods, the base's own delay and ramp, and slack."""
    robot = rig.config.robot
    base = CREATE3 if robot.ros2.bumper_type == "HazardDetectionVector" else ROBOTINO
    velocity = Velocity(robot.speed_m_s, 0.0, robot.turn_rad_s)
    return 2 * PERIOD_S + base.stop_time_s(velocity) + SLACK_S


def well(state: RobotState) -> bool:
    return state.reason == "" and state.state in ("waiting", "driving", "recovering")


@pytest.mark.parametrize(
    ("fault", "well_again", "reason"),
    [
        ({"wrong_type": True}, {"wrong_type": False}, "listens for TwistStamped on cmd_vel"),
        ({"nobody_listens": True}, {"nobody_listens": False}, "nothing on the robot listens"),
        ({"odometry": "frozen"}, {"odometry": ""}, "odometry"),
        ({"odometry": "constant"}, {"odometry": ""}, "odometry: stands"),
        ({"camera": "frozen"}, {"camera": ""}, "camera"),
        ({"camera": "restamped"}, {"camera": ""}, "camera"),
        ({"camera_late_s": 30.0}, {"camera_late_s": 0.0}, "camera: nothing new"),
        ({"bumper": "muted"}, {"bumper": ""}, "bumper"),
        ({"battery_low": True}, {"battery_low": False}, "battery: low"),
        ({"payload": "truncated"}, {"payload": ""}, ""),
        ({"payload": "truncated", "payload_of": "camera"}, {"payload": ""}, "camera"),
        ({"payload": "truncated", "payload_of": "bumper"}, {"payload": ""}, "bumper"),
    ],
    ids=lambda value: "-".join(map(str, value.values())) if isinstance(value, dict) else "",
)
def test_the_robot_stands_while_something_is_wrong_and_goes_on_after(
    fault: dict[str, object], well_again: dict[str, object], reason: str, rig: Ros2Rig
) -> None:
    rig.wait_driving()
    assert rig.wait_still(rig.faults(**fault)) < allowed_s(rig)
    told = rig.wait_state(
        lambda state: state.state == "blocked" and reason in state.reason, "the driver says why"
    )
    assert told.blocks >= 1
    assert rig.truth()["still_since_s"] is not None
    rig.faults(**{"payload_of": "all", **well_again})
    rig.wait_driving()
    rig.wait_state(well, "the driver says that all is well")


@pytest.mark.parametrize("payload", ["big-endian", "padded"])
def test_odd_payloads_that_are_still_good_stop_nobody(payload: str, rig: Ros2Rig) -> None:
    rig.wait_driving()
    before = rig.wait_state(well, "a heartbeat")
    rig.faults(payload=payload)
    rig.wait_state(
        lambda state: well(state) and state.sequence > before.sequence + 10, "it drives on"
    )
    rig.faults(payload="")


def test_what_comes_a_second_time_is_told_and_changes_nothing(rig: Ros2Rig) -> None:
    rig.wait_driving()
    before = rig.wait_state(well, "a heartbeat")
    rig.faults(duplicates=True)
    rig.wait_state(
        lambda state: (
            any(f.name == "odometry: repeated or late" for f in state.faults)
            and state.sequence > before.sequence + 5
        ),
        "duplicates are counted, and it drives on",
    )
    rig.faults(duplicates=False)


@pytest.mark.parametrize("closed_s", [0.5, 5.0])
def test_a_session_that_closes_and_comes_back(closed_s: float, rig: Ros2Rig) -> None:
    """Nothing reaches the robot: its own watchdog stops it, and it goes on by itself after."""
    rig.wait_driving()
    before = rig.wait_state(well, "a heartbeat")
    closed_at_s = rig.faults(closed_s=closed_s)
    rig.wait_state(lambda state: state.blocks > before.blocks, "the driver has noticed")
    after = rig.truth()
    if closed_s > allowed_s(rig) and after["still_since_s"] is not None:
        assert after["still_since_s"] < closed_at_s + allowed_s(rig)
    rig.wait_driving()
    rig.wait_state(lambda state: well(state) and state.sequence > before.sequence, "actions go on")


def test_the_bases_watchdog_stops_it_while_the_driver_is_frozen(rig: Ros2Rig) -> None:
    rig.wait_driving()
    before = rig.truth()["watchdog_stops"]
    assert rig.wait_still(rig.signal("driver", signal.SIGSTOP)) < allowed_s(rig)
    assert rig.truth()["watchdog_stops"] > before
    rig.signal("driver", signal.SIGCONT)
    rig.wait_driving()


def test_the_robot_stands_when_the_actor_is_killed(rig: Ros2Rig) -> None:
    rig.wait_driving()
    assert rig.wait_still(rig.kill("actor")) < allowed_s(rig)
    rig.start("actor")
    rig.wait_driving()


def test_a_stuck_bumper_ends_in_standing_still_and_not_in_pushing(rig: Ros2Rig) -> None:
    rig.wait_driving()
    rig.faults(bumper="stuck")
    rig.wait_state(
        lambda state: state.state == "blocked" and "pressed" in state.reason, "it gives up"
    )
    rig.faults(bumper="")
    rig.wait_driving()
