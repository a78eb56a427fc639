"""Actor or driver killed: the open episode is dropped and counted, the rest is there once."""

from __future__ import annotations

from pathlib import Path

import pytest
from cluster import ALL, Cluster, make_config

from benchmarks.waiting import wait_until
from services.replay.storage import Storage
from shared.keys import ACTOR_STATE
from shared.messages import ActorState

pytestmark = [pytest.mark.system, pytest.mark.timeout(200)]


@pytest.mark.parametrize("victim", ["actor", "driver"])
def test_killed_mid_episode_loses_only_the_open_episode(victim: str, tmp_path: Path) -> None:
    config = make_config(f"killed-{victim}")
    with Cluster(config, tmp_path / "run") as cluster:
        cluster.start(*ALL)
        cluster.wait_episodes(5, 90)
        inbox = cluster.bus.inbox()
        inbox.subscribe(ACTOR_STATE)

        def mid_episode() -> bool:
            states = inbox.take(ACTOR_STATE, ActorState)
            return any(s.step >= 2 and s.phase == "driving" for _, s in states)

        wait_until(mid_episode, 60, "an open episode with some steps")
        cluster.kill(victim)
        before = cluster.replay()
        assert before is not None
        cluster.start(victim)
        cluster.wait_episodes(before.episode + 15, 120)
        cluster.stop_all()

    storage = Storage(tmp_path / "run" / "replay", config.memory, f"{config.run.name}/7")
    counters, records = storage.counters(), storage.records()
    memory = storage.load()
    storage.close()
    memory.check_valid()
    assert counters.dropped_samples >= 1  # of an open episode what could not look ahead any more
    identities = [(r["robot"], r["life"], r["number"]) for r in records]
    assert len(set(identities)) == len(identities) == counters.commit
    episodes = [r["commit"]["episode"] for r in records if r["commit"]["episode"]]
    assert episodes == list(range(1, counters.episode + 1))
    if victim == "actor":  # the driver's numbering tells exactly what was lost
        assert counters.dropped_episodes >= 1
        lives = {r["life"] for r in records}
        assert len(lives) == 2
