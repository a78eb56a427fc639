"""Merging configuration sources, refusing wrong ones in one line, and owning a run folder."""

from __future__ import annotations

import fcntl
import os
import tomllib
from pathlib import Path
from typing import Any

import pytest

from shared import settings
from shared.config import Config
from shared.errors import ConfigError, StateError

PRESETS = Path(__file__).parents[3] / "shared" / "presets"


def test_defaults_without_any_source() -> None:
    assert settings.load() == Config()


def test_later_sources_win(tmp_path: Path) -> None:
    preset, file = tmp_path / "preset.toml", tmp_path / "file.toml"
    preset.write_text(
        "[memory]\ncapacity = 101\nequalise_every = 1\n[run]\nseed = 5\nepisodes = 1\n"
    )
    file.write_text("[memory]\nequalise_every = 2\n[run]\nseed = 6\nepisodes = 2\n")
    env = {"CORRIDOR_RUN__SEED": "7", "CORRIDOR_RUN__EPISODES": "3", "HOME": "/nowhere"}
    config = settings.load(str(preset), file, ["run.episodes=4"], env)
    assert config.memory.capacity == 101
    assert config.memory.equalise_every == 2
    assert config.run.seed == 7
    assert config.run.episodes == 4


def test_the_last_override_wins_and_deep_keys_work() -> None:
    env = {"CORRIDOR_ROBOT__CAMERA__HEIGHT_M": "0.5", "CORRIDOR_RUN__SEED": ""}
    config = settings.load(overrides=["run.seed=2", "run.seed = 3"], env=env)
    assert config.robot.camera.height_m == 0.5
    assert config.run.seed == 3


@pytest.mark.parametrize("text", ["2024", "true", "'2024'", '"2024"'])
def test_texts_stay_texts(text: str) -> None:
    assert settings.load(overrides=[f"run.name={text}"]).run.name == text.strip("'\"")


@pytest.mark.parametrize("name", settings.preset_names())
def test_every_preset_is_valid_and_lists_differences_only(name: str) -> None:
    listed = tomllib.loads((PRESETS / f"{name}.toml").read_text())
    different = [key for key, _, _ in settings.differences(Config(), settings.load(name))]
    assert sorted(settings.flatten(listed)) == sorted(different)


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("memory.capcity=3", ["memory.capcity: unknown key", "did you mean memory.capacity?"]),
        ("capacity=3", ["capacity: unknown key", "did you mean memory.capacity?"]),
        ("zzz.qqq=3", ["zzz.qqq: unknown key"]),
        ("memory=3", ["memory: expected a key inside", "memory.capacity"]),
        ("run.seed.x=1", ["run.seed.x: unknown key"]),
        ("memory.capacity=lots", ["memory.capacity: expected a valid integer, got 'lots'"]),
        ("memory.capacity=3", ["memory.capacity: expected greater than or equal to 30, got 3"]),
        ("memory.protect_terminal=1", ["memory.protect_terminal: expected a valid boolean, got 1"]),
        ("robot.kind=ros", ["robot.kind: expected 'sim', 'robotino' or 'ros2', got 'ros'"]),
        ("robot.speed_m_s=nan", ["robot.speed_m_s: expected a finite number, got nan"]),
        ("run.name=A/B", ["run.name: expected a text to match pattern", "got 'A/B'"]),
        ("network.filters=24", ["memory.strategy 'rmm' needs", "24", "memory.strategy: default"]),
        (
            "robot.speed_m_s=1.5",
            ["robot.speed_m_s (1.5) must not exceed robot.max_speed_m_s (0.8)"],
        ),
        ("bus.hang_s=2", ["bus.hang_s (2.0) must be 0 or at least three times bus.heartbeat_s"]),
    ],
)
def test_wrong_values_name_key_expectation_value_and_source(
    override: str, parts: list[str]
) -> None:
    with pytest.raises(ConfigError) as caught:
        settings.load(overrides=[override])
    message = str(caught.value)
    assert "\n" not in message
    for part in [*parts, "command line"]:
        assert part in message


def test_the_source_of_a_wrong_value_is_named(tmp_path: Path) -> None:
    bad = tmp_path / "bad.toml"
    bad.write_text("[run]\nseed = -1\n")
    with pytest.raises(ConfigError, match=r"run\.seed: .* got -1 \(preset file .*bad\.toml\)"):
        settings.load(str(bad))
    with pytest.raises(ConfigError, match=r"got -1 \(configuration file .*bad\.toml\)"):
        settings.load(file=bad)
    with pytest.raises(ConfigError, match=r"\(environment variable CORRIDOR_RUN__SEED\)"):
        settings.load(env={"CORRIDOR_RUN__SEED": "x"})
    with pytest.raises(ConfigError, match=r"foo: unknown key.*variable CORRIDOR_FOO"):
        settings.load(env={"CORRIDOR_FOO": "1"})


def test_an_impossible_combination_names_both_sources() -> None:
    with pytest.raises(ConfigError) as caught:
        settings.load(overrides=["robot.period_s=1"], env={"CORRIDOR_ROBOT__DEADMAN_S": "0.5"})
    message = str(caught.value)
    assert "robot.deadman_s: environment variable CORRIDOR_ROBOT__DEADMAN_S" in message
    assert "robot.period_s: command line" in message


@pytest.mark.parametrize(
    ("content", "part"),
    [
        (b"[run\n", "expected TOML"),
        (b"\xff\xfe", "expected TOML"),
        (b"run = 3\n", "run: expected a key inside this section"),
        (b"[[run]]\nseed = 1\n", "run: expected a key inside this section"),
        (b"[run]\nseed = 2020-01-01\n", "run.seed: expected a valid integer"),
    ],
)
def test_files_that_are_no_configuration(tmp_path: Path, content: bytes, part: str) -> None:
    file = tmp_path / "odd.toml"
    file.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        settings.load(file=file)
    assert part in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_files_and_presets() -> None:
    with pytest.raises(ConfigError, match=r"cannot be read: No such file"):
        settings.load(file=Path("/nowhere/x.toml"))
    with pytest.raises(ConfigError, match=r"expected one of .*demo.* got 'demi'"):
        settings.load("demi")
    with pytest.raises(ConfigError, match=r"expected section\.key=value, got 'seed'"):
        settings.load(overrides=["seed"])


@pytest.mark.parametrize("value", [1e-06, 1e16, 0.1, -3, True, 'a"\\\n\x7fü€😀', ""])
def test_single_values_survive_toml(value: Any) -> None:
    text = f"value = {settings.toml_value(value)}"
    assert tomllib.loads(text)["value"] == value


def test_what_is_written_reads_back_equal(tmp_path: Path) -> None:
    config = settings.load("demo", overrides=["learning.rmsprop_epsilon=1e-9", "run.seed=77"])
    path = tmp_path / "config.toml"
    settings.write(config, path)
    settings.write(config, path)
    assert settings.load(file=path) == config
    assert os.listdir(tmp_path) == ["config.toml"]


def test_claim_creates_the_folder_once(tmp_path: Path) -> None:
    folder = tmp_path / "runs" / "demo"
    config = settings.load("demo")
    assert settings.claim(folder, config) == config
    before = (folder / "config.toml").read_bytes()
    assert settings.claim(folder, config) == config
    assert (folder / "config.toml").read_bytes() == before
    assert os.listdir(folder) == ["config.toml"]


def test_claim_lets_endpoint_length_and_robot_differ(tmp_path: Path) -> None:
    config = settings.load("demo")
    settings.claim(tmp_path, config)
    other = settings.load(
        "demo", overrides=["bus.endpoint=tcp/127.0.0.1:9", "run.episodes=5", "robot.id=two"]
    )
    assert settings.claim(tmp_path, other) == config
    assert [key for key, _, _ in settings.differences(config, other)] == [
        "run.episodes",
        "bus.endpoint",
        "robot.id",
    ]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("memory.capacity=7000", "memory.capacity is 4000 there, but 7000 now"),
        ("run.seed=9", "run.seed is 1 there, but 9 now"),
        ("run.name=other", 'run.name is "demo" there, but "other" now'),
    ],
)
def test_claim_refuses_a_folder_of_another_configuration(
    tmp_path: Path, override: str, message: str
) -> None:
    settings.claim(tmp_path, settings.load("demo"))
    (tmp_path / "training.csv").write_text("episode\n" * 999)
    with pytest.raises(ConfigError) as caught:
        # A difference that would be allowed comes first in the tree and must not be blamed.
        settings.claim(tmp_path, settings.load("demo", overrides=["run.episodes=5", override]))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_folder_in_which_nothing_ran_takes_the_corrected_configuration(tmp_path: Path) -> None:
    wrong, right = (
        settings.load("demo", overrides=[f"robot.world={w}"]) for w in ("pluss", "plus")
    )
    settings.claim(tmp_path, wrong)
    (tmp_path / "run.json").touch()
    for name in ("logs", "numerics", "roles", "replay"):
        (tmp_path / name).mkdir()
    (tmp_path / "replay" / "data.mdb").write_bytes(bytes(8192))  # as if it could not be mapped
    with (tmp_path / "lock").open("w") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        with pytest.raises(ConfigError, match="another configuration"):  # it is starting now
            settings.claim(tmp_path, right)
    assert settings.claim(tmp_path, right) == settings.read_folder(tmp_path) == right
    assert not {"numerics", "run.json"} & set(os.listdir(tmp_path))


def test_a_folder_whose_name_is_no_text_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"'\S*\\udcff': expected a name in UTF-8"):
        settings.claim(tmp_path / os.fsdecode(b"run\xff"), Config())


def test_claim_of_a_damaged_folder_is_a_state_error(tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text("[run\n")
    with pytest.raises(StateError, match="damaged"):
        settings.claim(tmp_path, Config())


def test_claim_of_an_impossible_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be created"):
        settings.claim(tmp_path / "file" / "run", Config())
