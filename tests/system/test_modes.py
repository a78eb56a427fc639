"""Asynchronous learning, real time, and several robots on one memory."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from cluster import ALL, Cluster, make_config

from benchmarks.waiting import wait_until
from services.replay.storage import Storage
from shared.halts.orders import RobotOrder, order
from shared.keys import ACTOR_STATE, OBSERVATION, ROBOT_STATE
from shared.messages import ActorState, Observation, RobotState

pytestmark = [pytest.mark.system, pytest.mark.timeout(150)]
REALTIME = {"timing": "realtime", "period_s": 0.1, "deadman_s": 0.2}


def read_records(cluster: Cluster) -> list[dict[str, object]]:
    config = cluster.config
    storage = Storage(cluster.folder / "replay", config.memory, f"{config.run.name}/7")
    records: list[dict[str, object]] = storage.records()
    storage.load().check_valid()
    storage.close()
    return records


def test_asynchronous_learning_takes_up_weights_between_episodes(
    run_name: str, tmp_path: Path
) -> None:
    config = make_config(run_name, learning={"mode": "asynchronous"})
    with Cluster(config, tmp_path / "run") as cluster:
        cluster.start(*ALL)
        cluster.wait_episodes(30, 90)
        cluster.stop_all()
        versions = [int(r["weights_version"]) for r in read_records(cluster)]  # type: ignore[call-overload]
    assert versions == sorted(versions)
    assert versions[-1] > 5


def test_asynchronous_robot_waits_for_a_learner_too_far_behind(
    run_name: str, tmp_path: Path
) -> None:
    lag = 3
    config = make_config(run_name, learning={"mode": "asynchronous", "max_lag_episodes": lag})
    with Cluster(config, tmp_path / "run") as cluster:
        cluster.start(*ALL)
        cluster.wait_episodes(3, 90)
        cluster.freeze("learner")
        inbox = cluster.bus.inbox()
        inbox.subscribe(ACTOR_STATE)

        def waits() -> bool:
            return any(s.phase == "training" for _, s in inbox.take(ACTOR_STATE, ActorState))

        cluster.wait(waits, 60, "the actor waits for the learner")
        learner = cluster.learner()
        assert learner is not None

        def at_the_limit() -> bool:  # each tells of itself a little later
            replay = cluster.replay()
            return replay is not None and replay.episode - learner.episode == lag + 1

        cluster.wait(at_the_limit, 60, "replay to be as far ahead as it may be")
        replay = cluster.replay()
        assert replay is not None
        cluster.thaw("learner")
        cluster.wait_episodes(replay.episode + 5, 60)
        cluster.stop_all()


def test_two_robots_learn_into_one_memory(run_name: str, tmp_path: Path) -> None:
    config = make_config(run_name)
    with Cluster(config, tmp_path / "run") as cluster:
        cluster.start(*ALL)
        cluster.start_second_driver("robotino2")
        cluster.wait_episodes(20, 90)
        cluster.stop("driver-robotino2")
        cluster.stop_all()
        records = read_records(cluster)
    assert {r["robot"] for r in records} == {"robotino1", "robotino2"}
    counted = [r["commit"]["episode"] for r in records if r["commit"]["episode"]]  # type: ignore[index]
    assert counted == list(range(1, len(counted) + 1))


@pytest.mark.parametrize("learning", ["asynchronous", "synchronous"])
def test_realtime_robot_stops_when_the_actor_dies_and_goes_on_when_it_is_back(
    learning: str, run_name: str, tmp_path: Path
) -> None:
    config = make_config(run_name, robot=REALTIME, learning={"mode": learning})
    with Cluster(config, tmp_path / "run") as cluster:
        cluster.start(*ALL)
        inbox = cluster.bus.inbox()
        inbox.subscribe(OBSERVATION)

        def driven(metres: float) -> bool:
            """Whether the robot comes this far between two looks."""
            (_, first), *_ = wait_until(lambda: inbox.take(OBSERVATION, Observation), 20, "looks")
            deadline_s = time.monotonic() + 5
            while time.monotonic() < deadline_s:
                for _, now in inbox.take(OBSERVATION, Observation):
                    if abs(now.x_m - first.x_m) + abs(now.y_m - first.y_m) > metres:
                        return True
                inbox.wait(0.1)
            return False

        cluster.wait(lambda: driven(0.1), 60, "the robot drives")
        cluster.kill("actor")
        standing = {(o.x_m, o.y_m, o.heading_rad) for o in late_looks(cluster, 10)}
        assert len(standing) == 1
        cluster.start("actor")
        cluster.wait(lambda: driven(0.1), 60, "the robot drives again")
        cluster.stop_all()


def late_looks(cluster: Cluster, count: int) -> list[Observation]:
    """Observations of a robot whose actions do not come any more."""
    inbox = cluster.bus.inbox()
    inbox.subscribe(OBSERVATION)
    looks: list[Observation] = []

    def enough() -> bool:
        inbox.wait(0.2)
        looks.extend(o for _, o in inbox.take(OBSERVATION, Observation) if o.interruption == "late")
        return len(looks) >= count + 2

    wait_until(enough, 30, "late observations")
    return looks[2:]  # the first may still show the motion that just ended


def latched(cluster: Cluster) -> bool:
    inbox = cluster.bus.inbox()
    inbox.subscribe(ROBOT_STATE)
    inbox.wait(1.0)
    return any(s.state == "estop" for _, s in inbox.take(ROBOT_STATE, RobotState))


def test_estop_latches_until_cleared_and_the_run_goes_on(run_name: str, tmp_path: Path) -> None:
    config = make_config(run_name)
    with Cluster(config, tmp_path / "run") as cluster:
        cluster.start(*ALL)
        cluster.wait_episodes(2, 90)

        inbox = cluster.bus.inbox()
        inbox.subscribe(ROBOT_STATE)

        def command(name: RobotOrder) -> RobotState:
            assert order(cluster.bus, name, "", lambda _: None)
            inbox.take(ROBOT_STATE, RobotState)  # what was sent before

            def beat() -> RobotState | None:
                return next((s for _, s in inbox.take(ROBOT_STATE, RobotState)), None)

            return wait_until(beat, 10, "a heartbeat")  # type: ignore[return-value]

        stopped = command("estop")
        assert stopped.state == "estop"
        assert command("resume").state == "estop"
        assert command("pause").state == "estop"
        assert command("resume").sequence == stopped.sequence
        cluster.kill("driver")
        cluster.start("driver")
        cluster.wait(lambda: latched(cluster), 30, "the restarted driver is stopped too")
        assert command("clear").state != "estop"
        before = cluster.learner()
        assert before is not None
        cluster.wait_episodes(before.episode + 3, 60)
        paused = command("pause")
        beats: list[RobotState] = []

        def enough() -> bool:
            beats.extend(s for _, s in inbox.take(ROBOT_STATE, RobotState))
            return len(beats) >= 4

        wait_until(enough, 30, "heartbeats while paused")
        assert {b.sequence for b in beats} == {paused.sequence}
        command("resume")
        cluster.wait_episodes(before.episode + 6, 60)
        cluster.stop_all()
