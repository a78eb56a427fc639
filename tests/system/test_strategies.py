"""Every strategy of retention through the four services: equal to the single-process loop."""

from __future__ import annotations

from pathlib import Path

import pytest
from cluster import ALL, Cluster, make_config
from comparison import assert_equal, distributed, single_process

from shared.rl.retention.table import STRATEGIES

EPISODES = 16
ALWAYS = {"reservoir", "quotas", "quotas-reservoir"}
"""Strategies of which `make test` makes sure; the others are slow. `test_equality` has RMM."""
pytestmark = [pytest.mark.system, pytest.mark.timeout(200)]


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[] if n in ALWAYS else pytest.mark.slow) for n in STRATEGIES]
)
def test_it_does_the_same_through_the_services(name: str, run_name: str, tmp_path: Path) -> None:
    memory = {"strategy": name, "capacity": 60, "equalise_every": 5}
    learning = {"fit_every": 4, "fit_epochs": 1, "mini_batches_per_episode": 0}
    config = make_config(run_name, run={"episodes": EPISODES}, memory=memory, learning=learning)
    reference = single_process(config, EPISODES)
    assert len(reference.memory) <= 60
    assert reference.memory.ids[-1] > 90  # so there were discards
    with Cluster(config, tmp_path / "run") as cluster:
        cluster.start(*ALL)
        cluster.wait_episodes(EPISODES // 2, 90)
        cluster.kill("replay")
        cluster.start("replay")
        cluster.wait_episodes(EPISODES, 90)
        cluster.stop_all()
    assert_equal(reference, distributed(config, tmp_path / "run"))
