"""`corridor drive`: a frozen network drives a robot that does not know the difference (A45)."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from cluster import Cluster, free_port, make_config
from safetensors.torch import load, save

from benchmarks.robot_rig import Rig
from benchmarks.waiting import wait_until
from shared import settings
from shared.bus import Bus
from shared.config import Config
from shared.keys import OBSERVATION
from shared.messages import Observation
from shared.rl.network import initialised, to_bytes

pytestmark = [pytest.mark.system, pytest.mark.timeout(400)]
DEADLINE_S = 200.0
REALTIME = {"timing": "realtime", "period_s": 0.2, "deadman_s": 0.4}


def weights_of(config: Config, folder: Path, bias: float) -> Path:
    """A network that predicts about `bias` for everything."""
    tensors = load(to_bytes(initialised(config.network, seed=3)))
    tensors["out.weight"] *= 0.01
    tensors["out.bias"][:] = bias
    path = folder / "weights.safetensors"
    path.write_bytes(save(tensors))
    return path


def corridor(cluster: Cluster | Rig, *words: object) -> subprocess.Popen[str]:
    """A command beside the cluster."""
    place = ["--endpoint", cluster.config.bus.endpoint, "--run", cluster.config.run.name]
    return subprocess.Popen(
        [sys.executable, "-m", "services.cli", *map(str, words), *place],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def drive(cluster: Cluster | Rig, weights: Path, *words: object) -> subprocess.Popen[str]:
    filters = f"network.filters={cluster.config.network.filters}"
    return corridor(cluster, "drive", weights, "--set", filters, *words)


def heard(bus: Bus) -> list[Observation]:
    inbox = bus.inbox()
    inbox.subscribe(OBSERVATION)
    looks: list[Observation] = []

    def enough() -> bool:
        inbox.wait(0.2)
        looks.extend(o for _, o in inbox.take(OBSERVATION, Observation))
        return len(looks) >= 5

    wait_until(enough, DEADLINE_S, "observations")
    return looks


@pytest.mark.parametrize("robot", [{}, REALTIME], ids=["lockstep", "realtime"])
def test_a_frozen_network_drives(robot: dict[str, object], run_name: str, tmp_path: Path) -> None:
    config = make_config(run_name, robot=robot)
    with Cluster(config, tmp_path / "run") as cluster:
        cluster.start("router", "driver")
        before = heard(cluster.bus)[0]
        with drive(cluster, weights_of(config, tmp_path, 0.5), "--actions", 12) as process:
            said, _ = process.communicate(timeout=DEADLINE_S)
        assert process.returncode == 0, said
        assert "12 actions, 0 turns on the spot" in said
        after = heard(cluster.bus)[-1]
        assert after.sequence == before.sequence + 12
        assert (after.x_m, after.y_m) != (before.x_m, before.y_m)
        cluster.stop("driver", "router")


@pytest.mark.parametrize("robot", [{}, REALTIME], ids=["lockstep", "realtime"])
def test_it_turns_on_the_spot_where_it_predicts_nothing_good(
    robot: dict[str, object], run_name: str, tmp_path: Path
) -> None:
    config = make_config(run_name, robot=robot)
    with Cluster(config, tmp_path / "run") as cluster:
        cluster.start("router", "driver")
        with drive(cluster, weights_of(config, tmp_path, -0.5)) as process:
            turned: list[Observation] = []

            def turns() -> bool:
                turned.extend(o for o in heard(cluster.bus) if o.interruption == "moved")
                return len({o.heading_rad for o in turned}) >= 3

            cluster.wait(turns, DEADLINE_S, "turns on the spot")
            second = drive(cluster, weights_of(config, tmp_path, -0.5))
            refused, _ = second.communicate(timeout=DEADLINE_S)
            assert second.returncode == 1
            assert "is commanded by actor 'robotino1'" in refused
            process.send_signal(2)
            said, _ = process.communicate(timeout=DEADLINE_S)
        assert process.returncode == 0, said
        # After two full turns (about 60 motions) it drives an action on regardless (E33).
        actions, turned_times = map(int, re.findall(r"(\d+) actions, (\d+) turns", said)[-1])
        assert turned_times >= max(3, 20 * actions)
        for sequence in {o.sequence for o in turned}:
            assert len({(o.x_m, o.y_m) for o in turned if o.sequence == sequence}) == 1
        cluster.wait(
            lambda: len({o.heading_rad for o in heard(cluster.bus)}) == 1, DEADLINE_S, "it stands"
        )
        cluster.stop("driver", "router")


def test_it_drives_and_turns_a_real_robot(tmp_path: Path) -> None:
    config = Config.model_validate(
        {
            "run": {"name": "real"},
            "bus": {"endpoint": f"tcp/127.0.0.1:{free_port()}"},
            "network": {"filters": 8},
            "robot": {
                "kind": "robotino",
                "timing": "realtime",
                "period_s": 0.5,
                "deadman_s": 1.0,
                "speed_m_s": 0.15,
                "turn_rad_s": 0.75,
                "hardware": {"open_timeout_s": 60.0},
            },
        }
    )
    with Rig(config, tmp_path / "run") as rig:
        rig.start("router", "driver")
        before = heard(rig.bus)[0]
        with drive(rig, weights_of(config, tmp_path, 0.5), "--actions", 4) as process:
            said, _ = process.communicate(timeout=DEADLINE_S)
        assert process.returncode == 0, said
        after = heard(rig.bus)[-1]
        assert after.sequence >= before.sequence + 4
        assert (after.x_m, after.y_m) != (before.x_m, before.y_m)
        with drive(rig, weights_of(config, tmp_path, -0.5)) as process:
            rig.wait(
                lambda: any(abs(o.heading_rad - after.heading_rad) > 0.3 for o in heard(rig.bus)),
                "it turns on the spot",
            )
            process.kill()  # no farewell: the driver sees to it
            process.communicate(timeout=DEADLINE_S)
        rig.wait(lambda: rig.truth()["still_since_s"] is not None, "it stands")
        rig.stop("driver")


def test_a_bundle_drives_with_one_command_and_no_run(tmp_path: Path, run_name: str) -> None:
    config = make_config(run_name)
    run = tmp_path / "run"
    settings.claim(run, config)
    weights_of(config, run, 0.5)
    words = [sys.executable, "-P", "-m", "services.cli"]
    for command in (["bundle", str(run), "--out", "robot.bundle"], ["drive", "robot.bundle"]):
        more = ["--actions", "6"] if command[0] == "drive" else []
        done = subprocess.run(
            [*words, *command, *more],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=DEADLINE_S,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
    assert "6 actions, 0 turns on the spot" in done.stdout
    assert not (tmp_path / "runs" / "drive" / "endpoint").exists()
