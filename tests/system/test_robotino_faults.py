"""The fault table of the Robotino (H2, H7): whatever fails, the robot stands, and goes on after.

Reaction times are measured by `benchmarks/robot_reaction.py`; here the bound is generous.
"""

from __future__ import annotations

import math
import signal
from collections.abc import Iterator

import msgpack
import pytest
from cluster import free_port

from benchmarks.robot_rig import PARTS, Rig
from benchmarks.standin_actor import answer
from services.robot_driver.emulation.dynamics import ROBOTINO
from services.robot_driver.robot import Velocity
from shared.codec import encode
from shared.config import Config
from shared.keys import ACTION, OBSERVATION
from shared.messages import Observation, RobotState

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]
SPEED_M_S, TURN_RAD_S, PERIOD_S = 0.15, 0.75, 0.4
SLACK_S = 1.0
"""Test machines stall."""
ALLOWED_S = 2 * PERIOD_S + ROBOTINO.stop_time_s(Velocity(SPEED_M_S, 0.0, TURN_RAD_S)) + SLACK_S


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    config = Config.model_validate(
        {
            "run": {"name": "faults"},
            "bus": {"endpoint": f"tcp/127.0.0.1:{free_port()}", "heartbeat_s": 0.2},
            "robot": {
                "kind": "robotino",
                "timing": "realtime",
                "period_s": PERIOD_S,
                "speed_m_s": SPEED_M_S,
                "turn_rad_s": TURN_RAD_S,
                "deadman_s": 0.6,
                "hardware": {
                    "camera_stale_s": 0.7,
                    "odometry_stale_s": 0.7,
                    "bumper_stale_s": 0.7,
                    "open_timeout_s": 60.0,
                },
                "robotino": {"battery_period_s": 0.2},
            },
        }
    )
    with Rig(config, tmp_path_factory.mktemp("faults")) as one:
        one.start("router", "driver", "actor")
        yield one


def well(state: RobotState) -> bool:
    return state.reason == "" and state.state in ("waiting", "driving", "recovering")


@pytest.mark.parametrize(
    ("fault", "well_again", "reason"),
    [
        ({"camera": "frozen"}, {"camera": ""}, "camera"),
        ({"camera": "500"}, {"camera": ""}, "camera"),
        ({"camera": "truncated"}, {"camera": ""}, "camera"),
        ({"camera": "flat"}, {"camera": ""}, "camera"),
        ({"odometry": "frozen"}, {"odometry": ""}, "odometry"),
        ({"odometry": "constant"}, {"odometry": ""}, "odometry: stands"),
        ({"bumper": "unreadable"}, {"bumper": ""}, "bumper"),
        ({"bumper": "nonsense"}, {"bumper": ""}, "bumper"),
        ({"network": "cut"}, {"network": ""}, ""),
        ({"network": "silent"}, {"network": ""}, ""),
        ({"network": "reset"}, {"network": ""}, ""),
        ({"commands": "refused"}, {"commands": ""}, "command"),
        ({"battery_low": True}, {"battery_low": False}, "battery: low"),
        ({"stall_s": 0.8}, {"stall_s": 0.0}, ""),
    ],
    ids=lambda value: "-".join(map(str, value.values())) if isinstance(value, dict) else "",
)
def test_the_robot_stands_while_something_is_wrong_and_goes_on_after(
    fault: dict[str, object], well_again: dict[str, object], reason: str, rig: Rig
) -> None:
    rig.wait_driving()
    assert rig.wait_still(rig.faults(**fault)) < ALLOWED_S
    told = rig.wait_state(
        lambda state: state.state == "blocked" and reason in state.reason, "the driver says why"
    )
    assert told.blocks >= 1
    assert rig.truth()["still_since_s"] is not None
    rig.faults(**well_again)
    rig.wait_driving()
    rig.wait_state(well, "the driver says that all is well")


def test_faults_are_counted_by_sensor_and_reason(rig: Rig) -> None:
    rig.faults(camera="truncated")
    rig.wait_state(
        lambda state: any(f.name == "camera: damaged or cut off" and f.count for f in state.faults),
        "the fault is told",
    )
    rig.faults(camera="")


@pytest.mark.parametrize("cut_s", [0.5, 5.0])
def test_a_cut_of_the_network_that_ends_by_itself(cut_s: float, rig: Rig) -> None:
    rig.wait_driving()
    before = rig.wait_state(well, "a heartbeat")
    cut_at_s = rig.faults(network="cut")
    rig.wait(lambda: rig.truth()["now_s"] >= cut_at_s + cut_s, "the cut is over")
    if cut_s > ALLOWED_S:
        assert rig.truth()["still_since_s"] < cut_at_s + ALLOWED_S
    rig.faults(network="")
    rig.wait_driving()
    after = rig.wait_state(
        lambda state: well(state) and state.sequence > before.sequence, "actions go on"
    )
    assert any(fault.count for fault in after.faults)


def test_the_robot_stands_when_the_actor_is_killed(rig: Rig) -> None:
    rig.wait_driving()
    assert rig.wait_still(rig.kill("actor")) < ALLOWED_S
    late = rig.wait_state(lambda state: state.late_actions > 0, "late actions are counted")
    assert late.reason == ""
    rig.start("actor")
    rig.wait_driving()


def test_the_robot_stands_while_the_actor_is_frozen(rig: Rig) -> None:
    rig.wait_driving()
    assert rig.wait_still(rig.signal("actor", signal.SIGSTOP)) < ALLOWED_S
    rig.signal("actor", signal.SIGCONT)
    rig.wait_driving()


def test_the_robot_stands_without_the_router(rig: Rig) -> None:
    rig.wait_driving()
    assert rig.wait_still(rig.kill("router")) < ALLOWED_S
    rig.start("router")
    rig.wait_driving()


def test_the_robots_watchdog_stops_it_when_the_driver_is_killed(rig: Rig) -> None:
    rig.wait_driving()
    before = rig.truth()["watchdog_stops"]
    assert rig.wait_still(rig.kill("driver")) < ALLOWED_S
    assert rig.truth()["watchdog_stops"] > before
    rig.start("driver")
    rig.wait_driving()


def test_the_robots_watchdog_stops_it_while_the_driver_is_frozen(rig: Rig) -> None:
    rig.wait_driving()
    assert rig.wait_still(rig.signal("driver", signal.SIGSTOP)) < ALLOWED_S
    rig.signal("driver", signal.SIGCONT)
    rig.wait_driving()


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e308, -1, 3, 10**30 % 2**63, "forward"])
def test_nonsense_for_an_action_moves_nothing(value: object, rig: Rig) -> None:
    rig.wait_driving()
    assert rig.wait_still(rig.signal("actor", signal.SIGSTOP)) < ALLOWED_S
    inbox = rig.bus.inbox()
    inbox.subscribe(OBSERVATION)
    before = rig.wait_state(lambda state: True, "a heartbeat")
    key = ACTION.key(rig.config.run.name, rig.config.robot.id)

    def refused() -> bool:
        inbox.wait(0.2)
        for _, seen in inbox.take(OBSERVATION, Observation):
            tree = msgpack.unpackb(encode(answer(seen, 1)))
            rig.bus._session.put(key, msgpack.packb({**tree, "action": value}))
        state = rig.state
        return state is not None and state.undecodable >= before.undecodable + 3

    def told() -> bool:
        rig.wait_state(lambda state: True, "a heartbeat")
        return refused()

    rig.wait(told, "nonsense is refused and counted")
    assert rig.truth()["still_since_s"] is not None
    rig.signal("actor", signal.SIGCONT)
    rig.wait_driving()


def test_a_clean_stop_and_a_restart_interrupt_but_lose_nothing(rig: Rig) -> None:
    rig.wait_driving()
    before = rig.wait_state(well, "a heartbeat")
    rig.stop("driver")
    assert rig.truth()["still_since_s"] is not None or rig.wait_still(rig.truth()["now_s"]) < 3.0
    inbox = rig.bus.inbox()
    inbox.subscribe(OBSERVATION)
    seen: list[Observation] = []

    def first() -> bool:
        inbox.wait(0.1)
        seen.extend(o for _, o in inbox.take(OBSERVATION, Observation))
        return bool(seen)

    rig.start("driver")
    rig.wait(first, "the driver looks again")
    assert seen[0].earlier == (before.life,)
    assert seen[0].sequence >= before.sequence
    rig.wait_driving()


def test_an_emergency_stop_holds_until_it_is_cleared(rig: Rig) -> None:
    """H7: zeros at once, kept over restarts of everybody, released by `clear` alone."""
    rig.wait_driving()
    at_s = rig.truth()["now_s"]
    assert rig.command("estop").state == "estop"
    assert rig.first_stop_s(at_s) < 0.05 + SLACK_S
    assert rig.wait_still(at_s) < ALLOWED_S
    zeros = [c for c in rig.truth()["commands"] if c["at_s"] >= at_s]
    assert len(zeros) >= 1
    for command in ("resume", "pause", "resume"):
        assert rig.command(command).state == "estop"
    rig.kill("actor")
    rig.start("actor")
    rig.kill("driver")
    rig.start("driver")
    rig.wait_state(lambda state: state.state == "estop", "the restarted driver is stopped too")
    still_s = rig.truth()["still_since_s"]
    assert still_s is not None
    assert rig.command("clear").state != "estop"
    rig.wait_driving()


def test_a_pause_keeps_everything(rig: Rig) -> None:
    rig.wait_driving()
    at_s = rig.truth()["now_s"]
    assert rig.command("pause").state == "paused"
    assert rig.wait_still(at_s) < ALLOWED_S
    stops = rig.wait(lambda: five_stops(rig, at_s), "five stops")
    assert len(stops) >= 5
    rig.command("resume")
    rig.wait_driving()


def five_stops(rig: Rig, since_s: float) -> list[object]:
    stops = [
        c for c in rig.truth()["commands"] if c["at_s"] >= since_s and not any(c[p] for p in PARTS)
    ]
    return stops if len(stops) >= 5 else []


def test_a_stuck_bumper_ends_in_standing_still_and_not_in_pushing(rig: Rig) -> None:
    rig.wait_driving()
    before = rig.truth()["pose"]
    rig.faults(bumper="stuck")
    rig.wait_state(
        lambda state: state.state == "blocked" and "pressed" in state.reason, "it gives up"
    )
    after = rig.truth()["pose"]
    assert math.hypot(after["x_m"] - before["x_m"], after["y_m"] - before["y_m"]) < 2.0
    rig.faults(bumper="")
    rig.wait_driving()


def test_an_emergency_stop_while_it_is_not_fit_outlasts_the_fault(rig: Rig) -> None:
    rig.wait_driving()
    rig.faults(camera="500")
    rig.wait_state(lambda state: state.state == "blocked", "it is not fit to drive")
    assert rig.command("estop").state == "estop"
    rig.faults(camera="")
    told = rig.wait_state(lambda state: state.reason == "", "it is fit again")
    assert told.state == "estop"
    rig.wait_still(0.0)
    still_since_s = rig.truth()["still_since_s"]
    for _ in range(5):
        rig.wait_state(lambda state: state.state == "estop", "another heartbeat")
    assert rig.truth()["still_since_s"] == still_since_s
    rig.command("clear")
    rig.wait_driving()
