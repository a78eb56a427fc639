"""The table of processes: every row names what exists, and the orders are those that are safe."""

from __future__ import annotations

import importlib.util
import subprocess
import tomllib
from pathlib import Path

from services.launcher.supervisor import STAGE_ENDS_S
from services.monitor.operator import STOP_ORDER
from services.processes import ACTOR, COMMAND, DRIVER, PROCESSES, ROUTER, SERVICES

ROOT = Path(__file__).parents[3]


def test_every_row_names_a_module_and_extras_that_exist() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for process in PROCESSES:
        assert importlib.util.find_spec(process.module) is not None
        assert set(process.extras) <= set(extras["optional-dependencies"])
        assert process.stop_stage < len(STAGE_ENDS_S)


def test_the_robot_stops_first_and_the_router_last() -> None:
    assert STOP_ORDER == ["driver", "actor", "learner", "replay"]
    stages = [process.stop_stage for process in PROCESSES]
    assert stages == sorted(stages, reverse=True)  # who starts later stops no later
    assert (DRIVER.stop_stage, ROUTER.stop_stage) == (0, 3)
    assert [process for process in PROCESSES if not process.may_finish] == [ROUTER]


def test_a_driver_has_the_id_of_its_robot_and_an_image_for_each_kind() -> None:
    assert {process.ident("robot1") for process in SERVICES if process != DRIVER} == {"main"}
    assert DRIVER.ident("robot1") == "robot1"
    assert ACTOR.images == ("actor",)
    assert DRIVER.images == ("driver-sim", "driver-robotino", "driver-ros2")


def test_a_folder_of_our_name_where_the_user_stands_is_ignored(tmp_path: Path) -> None:
    (tmp_path / "services").mkdir()
    (tmp_path / "services" / "__init__.py").write_text("raise SystemExit('shadowed')\n")
    done = subprocess.run([*COMMAND, "router", "--help"], cwd=tmp_path, capture_output=True)
    assert done.returncode == 0, done.stderr
