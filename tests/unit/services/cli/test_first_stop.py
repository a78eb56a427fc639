"""The first message of an emergency stop: what it means, and that it needs little."""

from __future__ import annotations

import fcntl
import subprocess
import sys
from pathlib import Path

import pytest

from services.cli import first_stop
from services.cli.first_stop import Target, find, message
from shared.codec import decode
from shared.halts.book import new_halt
from shared.messages import Halts

PLAIN = {"CORRIDOR_BUS__ENDPOINT": "tcp/h:1"}


def test_it_is_the_message_that_others_send() -> None:
    for robot in ("", "r1"):
        assert decode(message(17, robot), Halts) == new_halt("estop", robot, 17)


@pytest.mark.parametrize(
    ("words", "env", "target"),
    [
        ("--endpoint tcp/a:1", {}, Target("demo", "tcp/a:1", "", "")),
        ("--endpoint=tcp/a:1 --run x", PLAIN, Target("x", "tcp/a:1", "", "")),
        ("--robot r2", PLAIN, Target("demo", "tcp/h:1", "", "r2")),
        ("", {**PLAIN, "CORRIDOR_RUN__NAME": "y"}, Target("y", "tcp/h:1", "", "")),
        ("--credentials c", PLAIN, Target("demo", "tcp/h:1", "c", "")),
        ("--help", PLAIN, None),
        ("--robot", PLAIN, None),
        ("--robot R!", PLAIN, None),
        ("--run a/b", PLAIN, None),
        ("", {}, None),
    ],
)
def test_it_goes_where_the_whole_command_would(
    words: str, env: dict[str, str], target: Target | None, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert find(words.split(), env) == target


def test_it_finds_the_run_that_is_up_and_the_operators_certificate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "secure" / "operator").mkdir(parents=True)
    (tmp_path / "secure" / "operator" / "cert.pem").touch()
    for name in ("one", "two"):
        folder = tmp_path / "runs" / name
        folder.mkdir(parents=True)
        (folder / "config.toml").write_text(f'[run]\nname = "{name}"\n')
        (folder / "endpoint").write_text(f"tcp/{name}:1\n{tmp_path / 'secure'}\n")
    own = str(tmp_path / "secure" / "operator")
    with (tmp_path / "runs" / "two" / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert find([], {}) == Target("two", "tcp/two:1", own, "")
        assert find(["--run-dir", "runs/two"], {}) == Target("two", "tcp/two:1", own, "")
        assert find(["--run-dir", "runs/one"], {}) is None  # it is not up
    assert find([], {}) is None


def test_it_imports_neither_pydantic_nor_numpy_nor_typer() -> None:
    code = "import sys, services.cli.entry, services.cli.first_stop; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert not loaded & {"pydantic", "numpy", "typer", "rich", "torch", "shared.messages"}
    assert "zenoh" in loaded


def test_without_a_router_it_leaves_everything_to_the_whole_command() -> None:
    assert first_stop.send(["--endpoint", "tcp/127.0.0.1:1"]) is None
