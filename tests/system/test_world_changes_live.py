"""The world changes under a running system: by command, on schedule, over stops and kills."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cluster import ALL, Cluster, make_config
from comparison import assert_equal, distributed, single_process

from benchmarks.waiting import wait_until
from services.cli import main as cli
from shared.config import Config
from shared.inbox import Inbox
from shared.keys import OBSERVATION, ROBOT_STATE, ROBOT_WORLD
from shared.messages import Box, Observation, RobotState, WorldChange, WorldChanged

EPISODES = 26
pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]
IN_THE_CORNER = ["--x", "4.88", "--y", "3.08", "--length", "0.04", "--width", "0.04"]
"""Where no robot can be."""
IN_MINUS = ["--x", "4.0", "--y", "0.0"]


class Watch:
    """The newest heartbeat of the robot."""

    def __init__(self, cluster: Cluster) -> None:
        self._inbox: Inbox = cluster.bus.inbox()
        self._inbox.subscribe(ROBOT_STATE)
        self.newest: RobotState | None = None

    def state(self) -> RobotState:
        self.newest = None
        wait_until(self._beat, 30, "a heartbeat of the robot")
        assert self.newest is not None
        return self.newest

    def wait_world(self, world: str) -> None:
        """A heartbeat from before an answer may still be under way after it."""
        wait_until(lambda: self.state().world == world, 30, f"the robot in {world}")

    def _beat(self) -> bool:
        self._inbox.wait(0.2)
        states = [state for _, state in self._inbox.take(ROBOT_STATE, RobotState)]
        self.newest = states[-1] if states else self.newest
        return self.newest is not None


def test_commands_change_the_world_and_what_crosses_is_dropped_and_counted(
    run_name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = make_config(run_name)
    reach = ["--run", run_name, "--endpoint", config.bus.endpoint]

    def corridor(*command: str) -> str:
        assert cli.main([*command, *reach]) == 0
        return capsys.readouterr().out

    def dropped() -> bool:
        state = cluster.replay()
        return state is not None and state.dropped_samples > 0

    with Cluster(config, tmp_path / "run") as cluster:
        cluster.start(*ALL)
        cluster.wait_episodes(1, 90)
        watch = Watch(cluster)
        told = corridor("obstacle", "place", "corner", *IN_THE_CORNER)
        assert told == "robotino1: world plus, obstacles corner, 0 changes waiting\n"
        assert corridor("obstacle", "remove", "corner").endswith(
            "no obstacles, 0 changes waiting\n"
        )
        watch.wait_world("plus")
        # A switch right after a bump costs nothing, so it may take more than one.
        for world in ("minus", "plus") * 5:
            if not dropped():
                assert f"world {world}" in corridor("world", "switch", world, "--start", "0")
                watch.wait_world(world)
                learner = cluster.learner()
                assert learner is not None
                cluster.wait_episodes(learner.episode + 2, 60)
        cluster.wait(dropped, 10, "dropped samples are counted")
        corridor("world", "switch", "minus")
        corridor("obstacle", "place", "later", *IN_MINUS, "--at-episode", "1000000")
        life = watch.state().life
        cluster.kill("driver")
        cluster.start("driver")
        wait_until(lambda: watch.state().life != life, 30, "the new driver")
        assert (watch.state().world, watch.state().pending_changes) == ("minus", 1)
        told = " ".join(corridor("status").split())
        assert "in minus, action" in told
        assert "changes of the world waiting 1" in told
        learner = cluster.learner()
        assert learner is not None
        cluster.wait_episodes(learner.episode + 2, 60)
        cluster.stop_all()
    memory = distributed(config, tmp_path / "run").memory
    worlds = {memory.worlds[i] for i in np.unique(memory.rows["world"])}
    assert worlds == {"plus", "minus"}


def test_a_robot_in_real_time_goes_on_in_the_other_world(run_name: str, tmp_path: Path) -> None:
    realtime = {"timing": "realtime", "period_s": 0.1, "deadman_s": 0.2}
    with Cluster(make_config(run_name, robot=realtime), tmp_path / "run") as cluster:
        cluster.start(*ALL)
        inbox = cluster.bus.inbox()
        inbox.subscribe(OBSERVATION)
        looks: list[Observation] = []

        def moved(world: str) -> bool:
            """Whether actions were executed in this world."""
            inbox.wait(0.2)
            looks.extend(look for _, look in inbox.take(OBSERVATION, Observation))
            there = {look.sequence for look in looks if look.world == world}
            return len(there) > 5

        cluster.wait(lambda: moved("plus"), 60, "the robot drives")
        for wish in (
            WorldChange(kind="switch", world="minus"),
            WorldChange(kind="remove", name="box", at_episode=1),
        ):
            answer = cluster.bus.request(ROBOT_WORLD, wish, WorldChanged, ident="robotino1")
            assert answer.accepted == (wish.kind == "switch"), answer.reason
        cluster.wait(lambda: moved("minus"), 60, "the robot drives in the other world")
        first = next(look for look in looks if look.world == "minus")
        assert first.interruption == "world"
        assert first.attempt > 0
        Watch(cluster).wait_world("minus")
        cluster.stop_all()


@pytest.fixture(scope="module")
def config() -> Config:
    return make_config("changing", run={"episodes": EPISODES})


def scheduled() -> list[WorldChange]:
    """Two worlds and two boxes, one of them gone again, one during filling."""
    box = {"x_m": 3.8, "y_m": 1.6, "length_m": 0.5, "width_m": 0.3, "height_m": 0.4}
    return [
        WorldChange(kind="place", box=Box(name="first", rgb=(200, 30, 30), **box)),
        WorldChange(kind="switch", world="minus", at_episode=5),
        WorldChange(kind="switch", world="plus", start=2, at_episode=13),
        WorldChange(
            kind="place",
            at_episode=14,
            box=Box(name="b2", rgb=(0, 0, 90), **{**box, "y_m": -2.0, "heading_deg": 30.0}),
        ),
        WorldChange(kind="remove", name="b2", at_episode=20),
    ]


def test_a_run_with_scheduled_changes_equals_the_single_process_loop(
    config: Config, tmp_path: Path
) -> None:
    """Also when all services are stopped between, the driver with changes waiting."""
    reference = single_process(config, EPISODES, scheduled())
    names = {reference.memory.worlds[i] for i in np.unique(reference.memory.rows["world"])}
    assert names == {"plus", "minus"}
    with Cluster(config, tmp_path / "run") as cluster:
        cluster.start("router", "driver")
        Watch(cluster).state()  # from then on it answers
        for change in scheduled():
            answer = cluster.bus.request(ROBOT_WORLD, change, WorldChanged, ident="robotino1")
            assert answer.accepted, answer.reason
        cluster.start("replay", "learner", "actor")
        cluster.wait_episodes(8, 200)
        cluster.stop_all()
        cluster.start(*ALL)
        cluster.wait_episodes(16, 200)
        cluster.kill("replay")
        cluster.start("replay")
        cluster.wait_episodes(EPISODES, 200)
        cluster.stop_all()
    assert_equal(reference, distributed(config, tmp_path / "run"))
