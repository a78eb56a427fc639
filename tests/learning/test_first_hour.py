"""docs/first-hour.md: its commands run as they stand there, up to a robot in a new corridor."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]
ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"^```(sh|toml)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def test_its_commands_lead_to_a_robot_that_tours_a_new_corridor(tmp_path: Path) -> None:
    beside = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PATH": beside}
    said = ""
    for kind, text in BLOCK.findall((ROOT / "docs/first-hour.md").read_text()):
        if kind == "toml":
            path = tmp_path / text.splitlines()[0].removeprefix("# ")
            path.parent.mkdir(exist_ok=True)
            path.write_text(text)
            continue
        for command in text.splitlines():
            if command.startswith(("make setup", ". .venv")):
                continue  # this environment is made already
            done = subprocess.run(
                shlex.split(command),
                cwd=tmp_path,
                env=environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                check=False,
            )
            assert done.returncode == 0, f"{command}\n{done.stdout[-3000:]}"
            said += done.stdout
    assert list((tmp_path / "renders").glob("*.png"))
    assert (tmp_path / "ring.safetensors").exists()
    assert "300 actions" in said
