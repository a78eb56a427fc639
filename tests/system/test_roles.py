"""One process for each role, whoever starts when and where; the others say who has it."""

from __future__ import annotations

import random
import re
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from cluster import ALL, Cluster, make_config

from benchmarks.waiting import wait_until
from shared import roles, service
from shared.bus import Bus
from shared.config import BusConfig, Config
from shared.errors import RoleTaken
from shared.keys import ACTION
from shared.messages import PROTOCOL_VERSION, Action
from shared.service import new_life

pytestmark = [pytest.mark.system, pytest.mark.timeout(150)]
INTERLEAVINGS, CLAIMANTS = 20, 3


class Claimant(threading.Thread):
    """Wants a role after a moment; keeps it until it is let go."""

    def __init__(self, config: BusConfig, run: str, delay_s: float) -> None:
        super().__init__(daemon=True)
        self.bus, self.life, self._delay_s = Bus(config, run), new_life(), delay_s
        self.refusal: RoleTaken | None = None

    def run(self) -> None:
        threading.Event().wait(self._delay_s)
        try:
            with roles.claimed(self.bus, "replay", "main", self.life):
                self.bus.announce("replay", "main", self.life, PROTOCOL_VERSION, "0" * 16)
        except RoleTaken as error:
            self.refusal = error


def test_of_several_who_want_a_role_at_once_one_gets_it(router: str, run_name: str) -> None:
    draw, config = random.Random(7), BusConfig(endpoint=router)
    for number in range(INTERLEAVINGS):
        run = f"{run_name}-{number}"
        several = [Claimant(config, run, draw.uniform(0.0, 0.02)) for _ in range(CLAIMANTS)]
        for claimant in several:
            claimant.start()
        for claimant in several:
            claimant.join(30)
        winners = [claimant for claimant in several if claimant.refusal is None]
        assert len(winners) == 1, (number, [str(c.refusal) for c in several])
        assert [peer.life for peer in winners[0].bus.peers()] == [winners[0].life]
        for claimant in several:
            claimant.bus.close()


def test_of_two_that_meet_in_one_role_the_older_one_stays(
    router: str, run_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As when the router was away while the second one looked."""
    monkeypatch.setattr(service, "SETTLE_S", 0.5)
    config = Config.model_validate({"run": {"name": run_name}, "bus": {"endpoint": router}})
    with Bus(config.bus, run_name) as first, Bus(config.bus, run_name) as second:
        lives = ("f" * 12, "0" * 12)
        old, young = (
            service.Service("actor", "main", life, config, bus, service.StopFlag())
            for life, bus in zip(lives, (first, second), strict=True)
        )
        old.started_s -= 60.0
        for me in (old, young):
            me.bus.announce("actor", "main", me.life, PROTOCOL_VERSION, "0" * 16)
        with service.controlled(old), service.controlled(young):
            wait_until(young.stop.is_set, 30, "the younger one stops")
            assert young.taken_by == old.life
            assert not old.stop.is_set()
        assert old.taken_by == ""


@pytest.fixture
def cluster(tmp_path: Path, run_name: str) -> Iterator[Cluster]:
    with Cluster(make_config(run_name), tmp_path / "run") as cluster:
        cluster.start(*ALL)
        cluster.wait(lambda: len(cluster.bus.peers()) == 4, 60, "all services")
        yield cluster


def test_a_second_process_of_a_role_ends_and_names_the_first(
    cluster: Cluster, tmp_path: Path
) -> None:
    """In the same folder, elsewhere on the bus, and with another seed."""
    holders = {peer.service: peer for peer in cluster.bus.peers()}
    seeded = cluster.config.model_copy(
        update={"run": cluster.config.run.model_copy(update={"seed": 8})}
    )
    places = {
        "same": Cluster(cluster.config, cluster.folder),
        "elsewhere": Cluster(cluster.config, tmp_path / "other"),
        "seeded": Cluster(seeded, tmp_path / "seeded"),
        "seeded-same": Cluster(seeded, cluster.folder),
    }
    for name, holder in holders.items():
        for place, second in places.items():
            with second:
                code = second.run_to_its_end(name, f"{name}-{place}")
                told = second.log(f"{name}-{place}")
                assert code == 4, (place, told)
                assert re.search(rf"is held by \S+, process \d+, life {holder.life}", told), told
    assert {peer.life for peer in cluster.bus.peers()} == {peer.life for peer in holders.values()}
    cluster.wait_episodes(2, 90)


def test_a_role_of_which_the_holder_is_frozen_ends_with_its_lease(
    cluster: Cluster, tmp_path: Path
) -> None:
    """Another machine takes over; the first one ends when it wakes up."""
    frozen = next(peer.life for peer in cluster.bus.peers("actor"))
    cluster.freeze("actor")
    with Cluster(cluster.config, tmp_path / "other") as other:
        other.start("actor")

        def taken_over() -> bool:
            return [p.life != frozen for p in cluster.bus.peers("actor")] == [True]

        wait_until(taken_over, 30, "another actor")
        before = cluster.replay()
        assert before is not None
        cluster.wait_episodes(before.episode + 2, 90)
        cluster.thaw("actor")
        assert cluster.ended("actor") == 4
        assert "its role is taken" in cluster.log("actor")
        after = cluster.replay()
        assert after is not None
        cluster.wait_episodes(after.episode + 2, 90)


def test_an_actor_may_have_robots_of_its_own(cluster: Cluster, tmp_path: Path) -> None:
    """Two sites with an actor each share one memory; nobody serves the other's robots."""
    cluster.start_second_driver("second")
    inbox = cluster.bus.inbox()
    inbox.subscribe(ACTION)

    def served_by(robot: str, life: str) -> bool:
        inbox.wait(0.2)
        taken = [a.actor_life for name, a in inbox.take(ACTION, Action) if name == robot]
        return taken[-1:] == [life]

    def lives(ident: str) -> list[str]:
        return [peer.life for peer in cluster.bus.peers("actor", ident)]

    (main,) = lives("main")
    cluster.wait(lambda: served_by("second", main), 60, "one actor for both")
    with Cluster(cluster.config, tmp_path / "site") as site:
        site.start_actor("second,third")
        cluster.wait(lambda: bool(lives("second") and lives("third")), 60, "an actor of its own")
        (own,) = lives("second")
        cluster.wait(lambda: served_by("second", own), 60, "it serves its robot")
        cluster.wait(lambda: served_by("robotino1", main), 60, "and the other one the rest")
        with Cluster(cluster.config, tmp_path / "twin") as twin:
            twin.start_actor("third")
            assert twin.ended("actor") == 4
            assert f"life {own}" in twin.log("actor")
        assert not served_by("second", main)
        before = cluster.learner()
        assert before is not None
        cluster.wait_episodes(before.episode + 3, 90)
        site.stop("actor")
    cluster.wait(lambda: not served_by("second", own), 60, "nobody serves it")
    heard = cluster.bus.inbox()
    heard.subscribe(ACTION, "second")
    cluster.wait(lambda: heard.wait(1.0), 60, "it is served again")
