"""A stop that holds: whoever is doubled, frozen, restarted or cut off, no robot moves under it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from cluster import ALL, Cluster, make_config

from shared.errors import PeerMissing
from shared.halts.orders import order
from shared.inbox import Inbox
from shared.keys import HALT, OBSERVATION, RELEASE
from shared.messages import Deadline, Halts, Observation, Release, Standing

pytestmark = [pytest.mark.system, pytest.mark.timeout(150)]
QUIET_S = 1.5


class Watch:
    """What the robots of a run do, as their observations tell."""

    def __init__(self, cluster: Cluster) -> None:
        self._cluster = cluster
        self._inbox: Inbox = cluster.bus.inbox()
        self._inbox.subscribe(OBSERVATION)
        self.sequences: dict[str, int] = {}
        """The newest action of each life."""

    def update(self) -> dict[str, int]:
        for _, seen in self._inbox.take(OBSERVATION, Observation):
            self.sequences[seen.life] = seen.sequence
        return dict(self.sequences)

    def moves(self) -> None:
        """Wait until some robot has executed ten more actions."""
        first = self.update()

        def further() -> bool:
            now = self.update()
            return any(count >= first.get(life, 0) + 10 for life, count in now.items())

        self._cluster.wait(further, 60, "a robot moves")

    def stands(self) -> None:
        """Nobody tells of another action for a while."""
        self._inbox.wait(0.0)
        first, until_s = self.update(), time.monotonic() + QUIET_S
        while time.monotonic() < until_s:
            self._inbox.wait(0.1)
            assert self.update() == first


@pytest.fixture
def cluster(tmp_path: Path, run_name: str) -> Iterator[Cluster]:
    with Cluster(make_config(run_name), tmp_path / "run") as cluster:
        cluster.start(*ALL)
        cluster.wait(lambda: len(cluster.bus.peers()) == 4, 60, "all services")
        yield cluster


def command(cluster: Cluster, name: str, lines: list[str] | None = None) -> bool:
    """Give an order to all robots that are there now, and return whether all have followed it."""
    echo = (lines if lines is not None else []).append
    return order(cluster.bus, name, "", echo)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["estop", "pause"])
def test_a_halt_outlives_whatever_is_killed(cluster: Cluster, name: str) -> None:
    watch = Watch(cluster)
    watch.moves()
    assert command(cluster, name)
    watch.stands()
    cluster.kill("driver")
    cluster.start("driver")
    watch.stands()
    cluster.kill("driver", "actor", "replay", "learner")
    cluster.start("replay", "learner", "actor", "driver")
    cluster.wait(lambda: len(cluster.bus.peers()) == 4, 60, "all services")
    watch.stands()
    assert command(cluster, "clear" if name == "estop" else "resume")
    watch.moves()


def test_a_driver_that_was_away_learns_of_a_stop_from_the_services(
    cluster: Cluster, tmp_path: Path
) -> None:
    """Frozen, restarted in another folder, and cut off from the router."""
    watch, lines = Watch(cluster), list[str]()
    watch.moves()
    cluster.freeze("driver")
    until_s = time.monotonic() + 4.0  # longer than its lease

    def late() -> bool:
        return time.monotonic() > until_s

    assert not order_until(cluster, lines, late)
    assert any("has not answered" in line for line in lines), lines
    cluster.thaw("driver")
    cluster.wait(lambda: command(cluster, "estop"), 30, "the driver stands")
    watch.stands()
    cluster.kill("driver")
    with Cluster(cluster.config, tmp_path / "other") as other:
        other.start("driver")
        cluster.wait(lambda: bool(cluster.bus.peers("driver")), 30, "another driver")
        watch.stands()
        cluster.kill("router")
        cluster.start("router")
        cluster.wait(lambda: len(cluster.bus.peers("driver")) == 1, 60, "the driver is back")
        cluster.wait(lambda: command(cluster, "clear"), 60, "released")
        watch.moves()


def order_until(cluster: Cluster, lines: list[str], late: object) -> bool:
    try:
        return order(cluster.bus, "estop", "", lines.append, ended=late)  # type: ignore[arg-type]
    except PeerMissing:
        return False


def test_a_release_that_comes_late_does_nothing(cluster: Cluster) -> None:
    """As after ten seconds in which the driver was frozen."""
    watch = Watch(cluster)
    watch.moves()
    assert command(cluster, "estop")
    inbox = cluster.bus.inbox()

    answers: list[Standing] = []

    def standing() -> bool:
        inbox.ask_all(HALT, Halts(), timeout_s=1.0)
        inbox.wait(1.0)
        answers.extend(a for a in inbox.answers(Standing) if a.service == "driver")
        return bool(answers)

    cluster.wait(standing, 10, "the driver answers")
    told = answers[-1]
    (halt,) = told.halts
    cluster.freeze("driver")
    release = Release(
        numbers=(halt.number,), deadlines=(Deadline(life=told.life, until_s=told.clock_s + 2.0),)
    )
    inbox.ask_all(RELEASE, release, timeout_s=10.0)
    cluster.stall(2.5)
    cluster.thaw("driver")
    watch.stands()
    assert command(cluster, "clear")
    watch.moves()


def test_a_stop_reaches_all_robots_and_one_robot_alone(cluster: Cluster) -> None:
    watch, lines = Watch(cluster), list[str]()
    cluster.start_second_driver("second")
    cluster.wait(lambda: len(cluster.bus.peers("driver")) == 2, 60, "two robots")
    watch.moves()
    assert order(cluster.bus, "pause", "second", lines.append)
    assert [line.split()[0] for line in lines] == ["second"]
    watch.moves()  # the other one
    assert command(cluster, "estop", lines)
    assert len(lines) == 3
    watch.stands()
    assert order(cluster.bus, "clear", "robotino1", lines.append)
    watch.moves()
    assert command(cluster, "clear")
    watch.update()
