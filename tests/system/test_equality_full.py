"""The demo's own configuration with the full network: distributed equals single-process."""

from __future__ import annotations

from pathlib import Path

import pytest
from cluster import ALL, Cluster, free_port
from comparison import assert_equal, distributed, single_process

from shared import settings
from shared.numerics import settle

EPISODES = 60
pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(3000)]


def test_demo_with_the_full_network_equals_the_single_process_loop(tmp_path: Path) -> None:
    overrides = [
        "run.name=full-equality",
        f"run.episodes={EPISODES}",
        f"bus.endpoint=tcp/127.0.0.1:{free_port()}",
    ]
    config = settings.load("demo", None, overrides, {})
    assert config.network.filters == 64
    folder = tmp_path / "run"
    chosen = {
        role: settle(config, folder, role) for role in ("actor", "replay", "learner")
    }  # as `corridor up` does before anything else runs
    with Cluster(config, folder) as cluster:
        cluster.start(*ALL)
        cluster.wait_episodes(EPISODES, 1500)
        cluster.stop_all()
    numerics = config.numerics.model_copy(update=chosen)
    reference = single_process(config.model_copy(update={"numerics": numerics}), EPISODES)
    assert reference.version > EPISODES // 2
    assert_equal(reference, distributed(config, folder))
