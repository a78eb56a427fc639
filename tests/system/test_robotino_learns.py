"""The whole system trains through the emulated Robotino as it would through the robot."""

from __future__ import annotations

from pathlib import Path

import pytest
from cluster import Cluster, make_config

from benchmarks.realtime import emulator
from services.replay.storage import Storage
from shared import settings

pytestmark = [pytest.mark.system, pytest.mark.timeout(600)]
PATIENT = {f"{name}_stale_s": 4.0 for name in ("camera", "odometry", "bumper")}


def test_it_learns_in_real_time_and_one_service_makes_the_difference(
    run_name: str, tmp_path: Path
) -> None:
    pace = {"timing": "realtime", "period_s": 0.5, "speed_m_s": 0.2, "deadman_s": 1.0}
    config = make_config(
        run_name,
        robot={**pace, "turn_rad_s": 0.6, "recovery_distance_m": 0.2},
        memory={"capacity": 40},
        learning={"mode": "asynchronous", "fit_every": 2},
        episode={"max_samples": 30, "horizon": 10},
    )
    with emulator() as address, Cluster(config, tmp_path / "run") as cluster:
        cluster.start("router", "replay", "learner", "actor")
        # The others know of a simulation; only the driver is told which robot there is.
        real = {"address": address, "timeout_s": 2.0}
        tree = config.to_dict()
        tree["robot"].update(kind="robotino")
        tree["robot"]["robotino"].update(real)
        tree["robot"]["hardware"].update({**PATIENT, "open_timeout_s": 60.0})
        settings.write(type(config).model_validate(tree), tmp_path / "run.toml")
        cluster.start("driver")
        cluster.wait_episodes(3, 400)
        learner = cluster.learner()
        assert learner is not None
        assert learner.weights_version >= 2
        cluster.stop_all()
        storage = Storage(cluster.folder / "replay", config.memory, f"{config.run.name}/7")
        storage.load().check_valid()
        storage.close()
