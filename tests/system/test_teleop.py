"""`corridor teleop` and `takeover` at a pseudo-terminal: keys move the robot, their absence not."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest
from cluster import Cluster, make_config

from benchmarks.waiting import wait_until
from shared.keys import ACTOR_STATE, OBSERVATION, ROBOT_STATE
from shared.messages import ActorState, Observation, RobotState

pytestmark = [pytest.mark.system, pytest.mark.timeout(400)]
DEADLINE_S = 200.0
REALTIME = {"timing": "realtime", "period_s": 0.2, "deadman_s": 0.4}


class Terminal:
    """The keys and the screen of a command that drives by keys."""

    def __init__(self, cluster: Cluster, folder: Path, command: str = "teleop") -> None:
        self._keys, slave = pty.openpty()
        self._screen = folder / "screen"
        place = ["--endpoint", cluster.config.bus.endpoint, "--run", cluster.config.run.name]
        with self._screen.open("wb") as screen:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "services.cli", command, *place],
                stdin=slave,
                stdout=screen,
                stderr=screen,
                start_new_session=True,
            )
        os.close(slave)

    def press(self, keys: str) -> None:
        os.write(self._keys, keys.encode())

    def screen(self) -> str:
        return self._screen.read_text()

    def hang_up(self) -> None:
        os.close(self._keys)
        self._keys = -1

    def close(self) -> None:
        self.process.kill()
        self.process.wait(10)
        if self._keys >= 0:
            os.close(self._keys)


@contextmanager
def terminal(cluster: Cluster, folder: Path, command: str = "teleop") -> Iterator[Terminal]:
    opened = Terminal(cluster, folder, command)
    try:
        wait_until(lambda: "q: " in opened.screen(), DEADLINE_S, f"{command} is up")
        yield opened
    finally:
        opened.close()


class Eyes:
    """Where the robot is."""

    def __init__(self, cluster: Cluster) -> None:
        self._inbox = cluster.bus.inbox()
        self._inbox.subscribe(OBSERVATION)

    def look(self) -> Observation:
        def seen() -> Observation | None:
            self._inbox.wait(0.1)
            taken = self._inbox.take(OBSERVATION, Observation)
            return taken[0][1] if taken else None

        found = wait_until(seen, DEADLINE_S, "an observation")
        assert found is not None
        return found

    def place(self) -> tuple[float, float, float]:
        seen = self.look()
        return (seen.x_m, seen.y_m, seen.heading_rad)

    def stands(self) -> bool:
        """Whether several looks in a row are the same."""
        return len({self.place() for _ in range(4)}) == 1


@pytest.mark.parametrize("robot", [{}, REALTIME], ids=["lockstep", "realtime"])
def test_keys_place_the_robot(robot: dict[str, object], run_name: str, tmp_path: Path) -> None:
    with Cluster(make_config(run_name, robot=robot), tmp_path / "run") as cluster:
        cluster.start("router", "driver")
        eyes = Eyes(cluster)
        start = eyes.look()
        with terminal(cluster, tmp_path) as person:

            def moves(key: str, before: tuple[float, float, float]) -> bool:
                person.press(key)
                return eyes.place() != before

            for key in ("w", "\x1b[B", "a", "\x1b[C"):
                here = eyes.place()
                cluster.wait(partial(moves, key, here), DEADLINE_S, f"{key!r} moves")
                cluster.wait(eyes.stands, DEADLINE_S, f"it stands after {key!r}")
            assert eyes.look().sequence == start.sequence  # no action was driven
            person.press("e")
            cluster.wait(lambda: "estop" in person.screen(), DEADLINE_S, "emergency stop")
            states = cluster.bus.inbox()
            states.subscribe(ROBOT_STATE)
            (state,) = wait_until(
                lambda: states.wait(0.1) and states.take(ROBOT_STATE, RobotState),
                DEADLINE_S,
                "beat",
            )
            assert state[1].state == "estop"
            person.press("wwww")
            person.press("q")
            assert person.process.wait(DEADLINE_S) == 0, person.screen()
        cluster.stop("driver", "router")


def test_it_gives_way_to_an_actor_and_ends_with_its_terminal(run_name: str, tmp_path: Path) -> None:
    config = make_config(run_name)
    with Cluster(config, tmp_path / "run") as cluster:
        cluster.start("router", "driver")
        eyes = Eyes(cluster)
        eyes.look()
        with terminal(cluster, tmp_path) as person:
            person.hang_up()
            assert person.process.wait(DEADLINE_S) == 0, person.screen()
        with terminal(cluster, tmp_path) as person:
            cluster.bus.announce("actor", "main", "f" * 12, 1, config.fingerprint())
            assert person.process.wait(DEADLINE_S) == 1, person.screen()
            assert "is commanded by actor 'main'" in person.screen()
        refused = Terminal(cluster, tmp_path)
        assert refused.process.wait(DEADLINE_S) == 1
        assert "end it first (corridor stop --service actor)" in refused.screen()
        refused.close()
        cluster.stop("driver", "router")


def test_a_person_fills_the_memory_leaves_and_gives_the_robot_back(
    run_name: str, tmp_path: Path
) -> None:
    memory = {"fill": "human", "capacity": 30}
    config = make_config(run_name, robot={"period_s": 0.05}, memory=memory)
    with Cluster(config, tmp_path / "run") as cluster:
        cluster.start("router", "driver", "replay", "learner", "actor")
        inbox = cluster.bus.inbox()
        inbox.subscribe(ACTOR_STATE)

        def actor() -> ActorState:
            def newest() -> list[tuple[str, ActorState]]:
                inbox.wait(0.1)
                return inbox.take(ACTOR_STATE, ActorState)

            return wait_until(newest, DEADLINE_S, "a heartbeat of the actor")[0][1]

        cluster.wait(lambda: actor().phase == "person", DEADLINE_S, "the actor waits for a person")
        with terminal(cluster, tmp_path, "takeover") as person:

            def filled() -> bool:
                person.press("d")
                state = actor()
                return state.human_actions >= 30 and state.robot_episode > 0

            cluster.wait(filled, DEADLINE_S, "keys fill the memory and go on")
            assert actor().actions == actor().human_actions
        gone = actor()  # killed: the robot stands
        assert (gone.taken_over, actor().actions) == (True, actor().actions)
        with terminal(cluster, tmp_path, "takeover") as person:
            cluster.wait(lambda: "stands" in person.screen(), DEADLINE_S, "the actor's answer")
            wait_until(lambda: actor().person != gone.person, DEADLINE_S, "another person")
            person.press("q")
            assert person.process.wait(DEADLINE_S) == 0, person.screen()
        by_network = lambda: actor().actions - actor().human_actions  # noqa: E731
        cluster.wait(lambda: by_network() > 0, DEADLINE_S, "the network drives")
        cluster.stop("actor", "learner", "replay", "driver", "router")
