"""A bundle holds what its network needs, and is refused in one sentence where something differs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.torch import load as load_tensors
from safetensors.torch import load_file, save

from services.commander import bundle, frozen
from shared.config import Config
from shared.errors import ConfigError, StateError
from shared.provenance import BUNDLE
from shared.rl.network import initialised, to_bytes
from shared.settings import claim, load

CONFIG = Config.model_validate({"network": {"filters": 4}, "robot": {"speed_m_s": 0.5}})
WEIGHTS = to_bytes(initialised(CONFIG.network, seed=3))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    run = tmp_path / "run"
    claim(run, CONFIG)
    (run / "weights.safetensors").write_bytes(WEIGHTS)
    out = tmp_path / "robot.safetensors"
    bundle.make(run, out)
    return out


def changed(file: Path, **changes: object) -> frozen.Frozen:
    """The bundle with other contents, as another version of the program would write it."""
    found = frozen.read(file)
    content = json.loads(found.metadata[BUNDLE]) | changes
    file.write_bytes(save(load_tensors(found.data), {BUNDLE: json.dumps(content)}))
    return frozen.read(file)


def test_it_predicts_what_the_run_predicts_and_tells_where_it_comes_from(file: Path) -> None:
    found = frozen.read(file)
    made = bundle.of(found)
    assert made is not None
    assert made.network == CONFIG.network
    assert made.robot == CONFIG.robot
    assert made.provenance["run"] == CONFIG.run.name
    images = np.arange(50 * 75, dtype=np.uint8).reshape(1, 50, 75)
    plain = frozen.Frozen(file, WEIGHTS).predictor(CONFIG.network).all_values(images)
    assert np.array_equal(found.predictor(made.network).all_values(images), plain)
    assert load(overrides=bundle.overrides(made)).robot == CONFIG.robot


def test_other_programs_read_it_as_plain_weights(file: Path, tmp_path: Path) -> None:
    plain = tmp_path / "plain.safetensors"
    plain.write_bytes(WEIGHTS)
    assert load_file(file).keys() == load_file(plain).keys()
    with safe_open(file, framework="np") as opened:
        assert json.loads(opened.metadata()[BUNDLE])["actions"][0] == "forward"
    assert bundle.of(frozen.read(plain)) is None


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"format": 2}, "its format is 2, this program has 1"),
        ({"preprocessing": 1}, "its preprocessing is 1, this program has 2"),
        ({"image": [60, 80]}, "its image is 60, 80, this program has 50, 75"),
        ({"actions": ["forward", "back"]}, "its actions is forward, back, this program has"),
    ],
)
def test_another_version_is_refused_in_a_sentence_that_names_both(
    file: Path, changes: dict[str, object], sentence: str
) -> None:
    found = changed(file, **changes)
    with pytest.raises(ConfigError, match=sentence):
        bundle.of(found)


def test_another_shape_than_its_own_is_refused(file: Path) -> None:
    found = changed(file, network={"filters": 8})
    made = bundle.of(found)
    assert made is not None
    with pytest.raises(ConfigError, match=r"not a network with network\.filters = 8"):
        found.predictor(made.network)


@pytest.mark.parametrize(
    ("robot", "sentence"),
    [
        ({"speed_m_s": 0.4}, r"way of an action of 0\.125 m, this robot has 0\.1 m"),
        ({"turn_rad_s": 1.0}, r"turn of an action of 0\.349 radians, this robot has 0\.25 radians"),
        ({"camera": {"height_m": 0.2}}, r"height of the camera of 0\.3 m, this robot has 0\.2 m"),
        ({"camera": {"vertical_fov_deg": 60.0}}, "vertical view of the camera of 45 degrees"),
    ],
)
def test_a_robot_that_does_something_else_is_refused(
    file: Path, robot: dict[str, object], sentence: str
) -> None:
    made = bundle.of(frozen.read(file))
    assert made is not None
    bundle.refuse_misfit(file, made, CONFIG.robot)
    other = Config.model_validate({"robot": {"speed_m_s": 0.5, **robot}}).robot
    with pytest.raises(ConfigError, match=sentence):
        bundle.refuse_misfit(file, made, other)


@pytest.mark.parametrize("changes", [{"format": "x"}, {"more": 1}, {"robot": {"speed_m_s": -1}}])
def test_a_damaged_bundle_is_bad_state(file: Path, changes: dict[str, object]) -> None:
    found = changed(file, **changes)
    with pytest.raises(StateError, match="damaged bundle"):
        bundle.of(found)


def test_nothing_is_overwritten_and_nothing_made_of_nothing(file: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="exists already"):
        bundle.make(tmp_path / "run", file)
    with pytest.raises(ConfigError, match="there is no such folder"):
        bundle.make(tmp_path / "nowhere", tmp_path / "out")
