"""The command line as a function: help, exit codes, and one line for every refusal."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from services.cli import entry
from services.cli import main as cli
from services.cli.options import import_installed
from services.launcher.up import PORTS, child_specs, free_endpoint, reachable, run_all
from services.monitor.running import locked, reach
from shared import settings
from shared.config import BusConfig, Config
from shared.errors import ConfigError, StateError
from shared.place import is_up
from shared.service import guarded

COMMANDS = [
    "driver", "actor", "replay", "learner", "router", "up", "status", "stop",
    "estop", "clear", "pause", "resume", "config", "world", "diagnose", "runs", "streams",
]  # fmt: skip


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run folders are made below the working directory; no setting comes from outside."""
    monkeypatch.chdir(tmp_path)
    for name in list(os.environ):
        if name.startswith("CORRIDOR_"):
            monkeypatch.delenv(name)


def refused(capsys: pytest.CaptureFixture[str], code: int, *arguments: str) -> str:
    """The one line with which a command line is refused."""
    assert cli.main(arguments) == code
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.startswith("corridor: ")
    assert output.err.count("\n") == 1
    return output.err


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--help"]) == 0
    shown = capsys.readouterr().out
    for name in COMMANDS:
        assert f" {name} " in shown


@pytest.mark.parametrize("command", [*COMMANDS, "world list", "world render", "world check"])
def test_every_command_and_option_has_a_help_text(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    assert cli.main([*command.split(), "--help"]) == 0
    shown = capsys.readouterr().out
    options = [row for row in shown.splitlines() if row.startswith("│ -") or row.startswith("│ *")]
    assert options
    for row in options:
        words = row.strip("│ *").split("  ")
        assert len([word for word in words if word.strip()]) >= 2, row
    assert "--tethered" not in shown


def test_without_arguments_the_help_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2
    output = capsys.readouterr()
    assert "Usage: corridor" in output.out + output.err


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (("fly",), "No such command 'fly'"),
        (("driver", "--fly"), "No such option: --fly"),
        (("actor", "--seed", "x"), "--seed"),
        (("actor", "extra"), "extra"),
        (("config", "--set", "memory.capacity"), "--set: expected section.key=value"),
        (("config", "--set", "memory.capcity=1"), "did you mean memory.capacity?"),
        (("config", "--preset", "demi"), "got 'demi', did you mean demo?"),
        (("config", "--set", "robot.kind=robotin"), "did you mean robotino? (command line)"),
        (("up", "--set", "robot.world=pluss"), "did you mean plus?"),
        (("stauts",), "Did you mean 'status'"),
        (("runs", "lst"), "did you mean list?"),
        (("config", "--config", "none.toml"), "none.toml: cannot be read"),
        (("driver", "--run", "A b"), "run.name: expected a text to match pattern"),
        (("up", "--episodes", "-1"), "run.episodes: expected greater than or equal to 0, got -1"),
        (("up", "--endpoint", "tcp/127.0.0.1:1", "--listen", "tcp/127.0.0.1:2"), "--listen"),
        (("up", "--listen", "tcp/127.0.0.1:0"), "--listen: expected a fixed port"),
        (("router", "--listen", "tcp/127.0.0.1:99999"), "router: cannot listen on"),
        (("router", "--listen", "tcp/nonsense"), "router: cannot listen on"),
        (("router", "--listen", "nonsense"), "bus.endpoint: expected a text to match pattern"),
        (("estop", "--robot", "a/b"), "--robot: expected a name"),
    ],
)
def test_wrong_usage_is_one_line_and_exit_code_2(
    arguments: tuple[str, ...], part: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert part in refused(capsys, 2, *arguments)


def test_the_version_is_told_without_importing_much(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["corridor", "--version"])
    assert entry.main() == 0
    assert capsys.readouterr().out.startswith("corridor 0.")


def test_ctrl_c_before_anything_begins_has_an_exit_code_of_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(*_: object, **__: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "main", interrupted)
    assert entry.main() == 130


def test_nothing_is_left_behind_by_a_refusal(capsys: pytest.CaptureFixture[str]) -> None:
    refused(capsys, 2, "up", "--set", "memory.capacity=1")
    assert os.listdir() == []


def test_the_environment_is_read(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CORRIDOR_MEMORY__CAPACITY", "1")
    line = refused(capsys, 2, "config")
    assert "(environment variable CORRIDOR_MEMORY__CAPACITY)" in line
    assert cli.main(["config", "--set", "memory.capacity=100"]) == 0
    assert tomllib.loads(capsys.readouterr().out)["memory"]["capacity"] == 100


@pytest.mark.parametrize("command", [("check",), ("calibrate", "--out", "my.toml")])
def test_a_robot_that_is_simulated_or_does_not_answer_is_not_looked_at(
    command: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert "expected a real robot" in refused(capsys, 2, "robot", *command)
    there = ("robot.robotino.address=127.0.0.1:9", "robot.hardware.open_timeout_s=0.2")
    options = [f"--set={setting}" for setting in there]
    line = refused(capsys, 1, "robot", *command, "--preset", "robotino", *options)
    assert "no answer from 127.0.0.1:9" in line
    assert not Path("my.toml").exists()


def ran(folder: Path, config: Config) -> None:
    """A folder in which a run of this configuration learnt something."""
    settings.claim(folder, config)
    (folder / "learner").mkdir()
    (folder / "learner" / "checkpoint.safetensors").touch()


def test_dedicated_options_win_over_set(capsys: pytest.CaptureFixture[str]) -> None:
    ran(Path("other"), settings.load(overrides=["run.seed=5"]))
    options = ("--set", "run.seed=4", "--seed", "3", "--run-dir", "other")
    assert "run.seed is 5 there, but 3 now" in refused(capsys, 2, "up", *options)


def test_a_folder_of_another_configuration_is_refused_by_services_too(
    capsys: pytest.CaptureFixture[str],
) -> None:
    ran(Path("runs/demo"), settings.load("demo"))
    for command in ("up", "driver", "actor", "replay", "learner"):
        assert "episode.max_samples is 200 there, but 500 now" in refused(capsys, 2, command)


def test_a_damaged_folder_is_exit_code_3(capsys: pytest.CaptureFixture[str]) -> None:
    Path("runs/demo").mkdir(parents=True)
    Path("runs/demo/config.toml").write_text("[[[")
    assert "damaged" in refused(capsys, 3, "up")


@pytest.mark.parametrize("command", ["status", "stop", "estop", "clear", "pause", "resume"])
def test_without_a_router_commands_fail_in_one_line(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    line = refused(capsys, 1, command, "--endpoint", "tcp/127.0.0.1:1")
    assert "no Zenoh router at tcp/127.0.0.1:1" in line
    assert ".rs:" not in line


def test_a_missing_library_is_named_with_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "shared.rl.network", raising=False)
    with pytest.raises(
        ConfigError, match=r"actor: needs .* torch.* pip install 'corridor\[actor\]'"
    ):
        import_installed("shared.rl.network", "actor")
    with pytest.raises(ModuleNotFoundError):
        import_installed("services.actor.nothing", "actor")


def test_the_command_line_is_light() -> None:
    heavy = "torch pybullet zenoh cv2 pydantic rich"
    code = f"import sys, services.cli.main; print([m for m in {heavy.split()} if m in sys.modules])"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"


# ---------------------------------------------------------------- what `up` starts, and finding it


def test_children_get_the_stored_file_and_what_differs_from_it(tmp_path: Path) -> None:
    stored = settings.load("demo")
    config = settings.load("demo", overrides=["run.episodes=7", "bus.endpoint=tcp/127.0.0.1:8"])
    specs = {spec.name: spec for spec in child_specs(config, stored, tmp_path, "tcp/0.0.0.0:8")}
    assert sorted(specs) == ["actor", "driver", "learner", "replay", "router"]
    assert specs["driver"].stage < specs["actor"].stage < specs["replay"].stage
    assert specs["replay"].stage == specs["learner"].stage < specs["router"].stage
    assert "tcp/0.0.0.0:8" in specs["router"].command
    settings.write(stored, tmp_path / "config.toml")
    for name in ("actor", "driver", "learner", "replay"):
        command = specs[name].command
        sets = [word.removeprefix("--set=") for word in command if word.startswith("--set=")]
        file = Path(command[command.index("--config") + 1])
        assert settings.load(file=file, overrides=sets) == config
        assert "--tethered" in command


def test_children_get_the_credentials_and_the_router_what_it_may(tmp_path: Path) -> None:
    stored = settings.load("demo")
    config = settings.load("demo", overrides=["bus.credentials=/secure"])
    specs = {s.name: s for s in child_specs(config, stored, tmp_path, "tcp/127.0.0.1:8")}
    router = specs["router"].command
    assert router[router.index("--credentials") + 1] == "/secure"
    assert "--insecure" not in router
    assert '--set=bus.credentials="/secure"' in specs["actor"].command
    open_router = child_specs(stored, stored, tmp_path, "tcp/127.0.0.1:8")[0].command
    assert "--insecure" in open_router  # `up` has refused what must not be
    assert "--credentials" not in open_router


def test_a_given_endpoint_means_no_own_router(tmp_path: Path) -> None:
    names = [spec.name for spec in child_specs(Config(), Config(), tmp_path, None)]
    assert names == ["replay", "learner", "actor", "driver"]


def test_free_endpoints_are_outside_the_range_of_outgoing_connections() -> None:
    port = int(free_endpoint().rsplit(":", 1)[1])
    assert port in PORTS
    outgoing = Path("/proc/sys/net/ipv4/ip_local_port_range")
    if outgoing.exists():
        assert port < int(outgoing.read_text().split()[0])


def test_clients_reach_a_router_on_all_interfaces_by_loopback() -> None:
    assert reachable("tcp/0.0.0.0:7447") == "tcp/127.0.0.1:7447"
    assert reachable("tcp/[::]:7447") == "tcp/[::1]:7447"
    assert reachable("tcp/192.0.2.1:7447") == "tcp/192.0.2.1:7447"


def make_up(name: str, endpoint: str) -> Path:
    """A run folder as `corridor up` leaves it while it runs, but for the lock."""
    folder = Path("runs") / name
    settings.claim(folder, settings.load(overrides=[f"run.name={name}"]))
    (folder / "endpoint").write_text(endpoint + "\n")
    return folder


def test_the_only_run_that_is_up_is_found() -> None:
    folder = make_up("one", "tcp/127.0.0.1:5001")
    assert reach().run.name == "demo"  # not up: what lies there means nothing
    assert reach(run_dir=folder).bus == BusConfig()
    with locked(folder):
        assert is_up(folder)
        found = reach()
        assert (found.run.name, found.bus.endpoint) == ("one", "tcp/127.0.0.1:5001")
    assert not is_up(folder)
    assert reach().run.name == "demo"


def test_a_run_is_reached_with_the_credentials_it_uses_now() -> None:
    with locked(make_up("one", "tcp/127.0.0.1:5001\n/secure")):
        assert reach().bus.credentials == "/secure"
        assert reach(credentials="/mine").bus.credentials == "/mine"
    with locked(make_up("one", "tcp/127.0.0.1:5001")):
        assert reach().bus.credentials == ""


def test_of_several_runs_one_must_be_chosen() -> None:
    one, two = make_up("one", "tcp/127.0.0.1:5001"), make_up("two", "tcp/127.0.0.1:5002")
    with locked(one), locked(two):
        with pytest.raises(ConfigError, match=r"several runs are up.*runs/one, runs/two"):
            reach()
        assert reach(run="two").bus.endpoint == "tcp/127.0.0.1:5002"
        assert reach(run_dir=one).bus.endpoint == "tcp/127.0.0.1:5001"


def test_a_given_endpoint_is_taken_as_it_is() -> None:
    with locked(make_up("one", "tcp/127.0.0.1:5001")):
        assert reach(endpoint="tcp/127.0.0.1:9").bus.endpoint == "tcp/127.0.0.1:9"
        env = {"CORRIDOR_BUS__ENDPOINT": "tcp/127.0.0.1:8", "CORRIDOR_RUN__NAME": "x"}
        found = reach(env=env)
        assert (found.run.name, found.bus.endpoint) == ("x", "tcp/127.0.0.1:8")


def test_a_folder_without_configuration_is_a_state_error() -> None:
    Path("runs/odd").mkdir(parents=True)
    with pytest.raises(StateError):
        reach(run_dir=Path("runs/odd"))


def test_up_refuses_a_folder_in_use() -> None:
    folder = make_up("demo", "tcp/127.0.0.1:5001")
    with locked(folder), pytest.raises(ConfigError, match=f"process {os.getpid()}"):
        run_all(Config(), folder, listen=None, given=False)


def test_exit_codes_of_services() -> None:
    def fail_with(error: Exception) -> int:
        def main() -> None:
            raise error

        return guarded("replay", main)

    assert fail_with(ConfigError("x")) == 2
    assert fail_with(StateError("x")) == 3
    assert fail_with(RuntimeError("x")) == 1
