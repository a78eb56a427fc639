"""What a run leaves behind, read back by the libraries of the formats."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from builders import make_episode, make_images
from PIL import Image
from pyarrow import parquet

from services.cli import main as cli
from services.commander import frozen
from services.learner import checkpoint
from services.replay.storage import Storage
from shared.config import Config
from shared.rl.learning import Trainer
from shared.rl.memory import ReplayMemory
from shared.rl.retention.strategy import Discard
from shared.rl.turn import Maintenance
from shared.run_record import REPLAY_COLUMNS, TRAINING_COLUMNS, append_csv

CONFIG = Config.model_validate({"network": {"filters": 8}, "run": {"name": "lab", "seed": 3}})


def export(*words: object) -> int:
    return cli.main(["export", *map(str, words)])


@pytest.mark.parametrize("layout", ["ccpccp", "cpcccp"])
def test_weights_as_onnx_predict_the_same(tmp_path: Path, layout: Any) -> None:
    network = CONFIG.network.model_copy(update={"layout": layout})
    config = CONFIG.model_copy(update={"network": network})
    trainer = Trainer(network, config.learning, config.numerics.learner, 3)
    path = tmp_path / "learner" / "checkpoint.safetensors"
    checkpoint.write(path, trainer, 7, "lab/3", config=config)
    out = tmp_path / "lab.onnx"
    assert export("weights", tmp_path, "--out", out) == 0  # no config.toml: the file says it all
    images = make_images(1000)
    session = onnxruntime.InferenceSession(out)
    predicted = session.run(None, {"images": images})[0]
    expected = frozen.read(path).predictor(network).all_values(images)
    assert predicted.shape == (1000, 3)
    assert np.abs(predicted - expected).max() < 1e-5
    assert np.ptp(expected) > 0.1
    told = {item.key: json.loads(item.value) for item in onnx.load(out).metadata_props}
    assert told["bundle"]["provenance"]["episode"] == 7
    assert told["bundle"]["actions"][0] == "forward"


def test_a_memory_as_parquet_is_read_back_equal(tmp_path: Path) -> None:
    config = CONFIG.memory.model_copy(update={"fill": "none"})
    storage = Storage(tmp_path / "replay", config, "lab/3")
    memory = storage.load()
    for seed in (1, 2):
        storage.commit(make_episode(20, seed=seed))
        pending = storage.pending(seed - 1)
        assert pending is not None
        memory.worlds = pending.worlds
        memory.append(pending.rows, pending.images)
        storage.apply_turn(pending, memory, Maintenance(Discard(memory.capacity), False))
    storage.close()
    out = tmp_path / "memory.parquet"
    assert export("memory", tmp_path, "--out", out) == 0
    table = parquet.read_table(out).to_pydict()
    images = [np.asarray(Image.open(io.BytesIO(png))) for png in table["image"]]
    assert np.array_equal(np.stack(images), memory.images(np.arange(40)))
    assert table["world"] == [memory.worlds[i] for i in memory.rows["world"]]
    names = set(ReplayMemory(1).rows.dtype.names or ()) - {"slot", "world"}
    assert names == table.keys() - {"image", "world"}
    for name in names:
        assert np.array_equal(np.array(table[name]), memory.rows[name]), name


def test_metrics_as_parquet_have_numbers(tmp_path: Path) -> None:
    for episode in (1, 2):
        row = dict.fromkeys(REPLAY_COLUMNS, 1) | {"episode": episode, "world": "plus"}
        append_csv(tmp_path / "episodes.csv", REPLAY_COLUMNS, [row])
    trained = dict.fromkeys(TRAINING_COLUMNS, 2) | {"episode": 1, "loss": 0.25}
    append_csv(tmp_path / "training.csv", TRAINING_COLUMNS, [trained])
    out = tmp_path / "metrics.parquet"
    assert export("metrics", tmp_path, "--out", out) == 0
    table = parquet.read_table(out).to_pydict()
    assert table["episode"] == [1, 2]
    assert table["world"] == ["plus", "plus"]
    assert table["loss"] == [0.25, None]


def test_what_cannot_be_exported_is_said_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    there = tmp_path / "there"
    there.touch()
    assert export("nothing", tmp_path, "--out", tmp_path / "x") == 2
    assert export("memory", tmp_path, "--out", there) == 2
    assert export("memory", tmp_path, "--out", tmp_path / "x") == 3
    assert export("metrics", tmp_path, "--out", tmp_path / "x") == 3
    assert export("weights", tmp_path, "--out", tmp_path / "x") == 2
    said = capsys.readouterr().err.splitlines()
    assert "expected one of weights, memory, metrics, got 'nothing'" in said[0]
    assert "exists already" in said[1]
    assert "expected a replay memory, found none" in said[2]
    assert "no episode was recorded" in said[3]
    assert len(said) == 5
