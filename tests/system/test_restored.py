"""A memory that comes back from a backup is not taken for the one that the learner knows."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from cluster import ALL, Cluster, make_config

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]


def test_a_restored_memory_ends_the_learner_until_somebody_decides(
    run_name: str, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    memory, checkpoint = folder / "replay", folder / "learner" / "checkpoint.safetensors"
    with Cluster(make_config(run_name), folder) as cluster:
        cluster.start(*ALL)
        cluster.wait_episodes(2, 120)
        cluster.stop_all()
        shutil.copytree(memory, tmp_path / "backup")
        cluster.start(*ALL)
        cluster.wait_episodes(6, 120)
        cluster.stop_all()
        shutil.rmtree(memory)
        shutil.copytree(tmp_path / "backup", memory)

        cluster.start("router", "replay", "learner")
        cluster.wait(lambda: "replay has no turn" in cluster.log("learner"), 60, "it is refused")
        assert cluster._processes["learner"].wait(20) == 3
        assert "move the checkpoint away" in cluster.log("learner")
        refused = cluster.learner()
        assert refused is not None

        shutil.rmtree(checkpoint.parent)
        shutil.rmtree(folder / "actor")  # an open episode of weights that are no more
        cluster.start("learner", "actor", "driver")

        def goes_on() -> bool:
            state = cluster.learner()
            return state is not None and state.life != refused.life and state.episode >= 4

        cluster.wait(goes_on, 120, "a new learner trains on the restored memory")
        assert "it goes on as version" in (folder / "learner.out").read_text()
        cluster.stop_all()
