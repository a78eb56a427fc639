"""`corridor evaluate`: finds the network of a run, drives, writes what it found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from experiments.drives import routes
from experiments.records import EVALUATION_COLUMNS
from services.cli import main as cli
from services.commander import frozen
from services.learner import checkpoint
from shared import run_record
from shared.config import ActorNumerics, Config, NetworkConfig
from shared.rl.learning import Trainer
from shared.rl.network import initialised, to_bytes
from shared.rl.predictor import Predictor
from shared.settings import claim

SMALL = {"network": {"filters": 4}, "memory": {"strategy": "normm"}}
CONFIG = Config.model_validate({**SMALL, "robot": {"world": "minus"}})
WEIGHTS = to_bytes(initialised(CONFIG.network, seed=3))
QUICK = ["--starts", "2", "--actions", "60"]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a run of an experiment."""
    folder = tmp_path / "seed-1"
    claim(folder, CONFIG)
    (folder / "weights.safetensors").write_bytes(WEIGHTS)
    return folder


def corridor(*words: object) -> int:
    return cli.main([str(word) for word in words])


def test_table_csv_routes_and_pictures(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert corridor("evaluate", run, *QUICK, "--out", out) == 0
    said = capsys.readouterr().out
    assert "minus: 120 actions without learning" in said
    assert f"written to {out}" in said
    rows = run_record.read_csv(out / "evaluation.csv", EVALUATION_COLUMNS)
    assert [row["driver"] for row in rows] == ["network", "random", "planner"]
    assert [row["label"] for row in rows] == ["evaluate", "reference", "reference"]
    assert all(row["world"] == "minus" and row["actions"] == "120" for row in rows)
    assert (rows[2]["bumps"], float(rows[1]["bumps_per_1000"]) > 20) == ("0", True)
    for row in rows:
        route = routes.read(out / f"route-{row['driver']}.npz")
        assert (route.trace.world, len(route.trace.bumps)) == ("minus", 60)
        assert (out / f"routes-{row['driver']}.png").read_bytes().startswith(b"\x89PNG")


def test_the_same_run_gives_the_same_figures(run: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        assert corridor("evaluate", run, *QUICK, "--out", tmp_path / name) == 0
    a, b = ((tmp_path / name / "evaluation.csv").read_bytes() for name in ("a", "b"))
    assert a == b


def test_another_world_can_be_named(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["--world", "plus", "--starts", 1, "--actions", 2, "--out", out]
    assert corridor("evaluate", run, *words) == 0
    rows = run_record.read_csv(out / "evaluation.csv", EVALUATION_COLUMNS)
    assert {row["world"] for row in rows} == {"plus"}


def test_of_a_checkpoint_the_target_network_drives(tmp_path: Path) -> None:
    trainer = Trainer(CONFIG.network, CONFIG.learning, CONFIG.numerics.learner, seed=3)
    with torch.no_grad():
        trainer.train_network.out.bias += 1.0
    (tmp_path / "learner").mkdir()
    path = tmp_path / "learner" / "checkpoint.safetensors"
    checkpoint.write(path, trainer, episode=7, identity="demo/3")
    found = frozen.read(frozen.find(tmp_path))
    assert (found.path, found.episode, found.train_steps) == (path, 7, 0)
    image = np.full((1, 50, 75), 99, np.uint8)
    plain = frozen.Frozen(path, WEIGHTS).predictor(CONFIG.network).all_values(image)
    assert np.array_equal(found.predictor(CONFIG.network).all_values(image), plain)


def test_a_file_of_weights_alone_will_do(run: Path, tmp_path: Path) -> None:
    alone = tmp_path / "else" / "mine.safetensors"
    alone.parent.mkdir()
    alone.write_bytes(WEIGHTS)
    found = frozen.read(frozen.find(alone))
    assert (found.episode, found.train_steps) == (None, None)
    image = np.full((1, 50, 75), 99, np.uint8)
    expected = Predictor(CONFIG.network, ActorNumerics())
    expected.load(0, WEIGHTS)
    values = found.predictor(CONFIG.network).all_values(image)
    assert np.array_equal(values, expected.all_values(image))
    settings = ["--set", "network.filters=4", "--world", "minus"]
    assert corridor("evaluate", alone, *QUICK, *settings, "--out", tmp_path / "out") == 0


def refused(capsys: pytest.CaptureFixture[str], code: int, *words: object) -> str:
    assert corridor("evaluate", *words) == code
    said = capsys.readouterr().err
    assert said.startswith("corridor: ")
    assert said.count("\n") == 1
    return said


def test_wrong_runs_are_refused_in_one_line(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", tmp_path / "out"]
    missing = tmp_path / "nowhere"
    assert f"run {missing}: there is no such" in refused(capsys, 2, missing, *out)
    assert "expected learner/checkpoint.safetensors or weights.safetensors" in refused(
        capsys, 2, tmp_path, *out
    )
    said = refused(capsys, 2, run, "--world", "moon", *out)
    assert "robot.world: no world named 'moon'; there are:" in said
    other = refused(capsys, 2, run, "--set", "network.filters=8", *out)
    assert "not a network with network.filters = 8" in other
    assert "expected float32 [" in other, "the first tensor that differs"
    (run / "weights.safetensors").write_bytes(WEIGHTS[:-9])
    assert "damaged weights" in refused(capsys, 3, run, *out)
    for state in ("[]", '{"counters": 1}'):
        save_file({"something": torch.zeros(3)}, run / "weights.safetensors", {"state": state})
        assert "damaged weights" in refused(capsys, 3, run, *out)
    save_file({"something": torch.zeros(3)}, run / "weights.safetensors")
    assert "differs in" in refused(capsys, 2, run, *out)
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_written_is_told(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert "file/out: cannot be written" in refused(
        capsys, 2, run, *QUICK, "--out", tmp_path / "file" / "out"
    )


def test_shape_of_the_network_is_the_configured_one() -> None:
    with pytest.raises(Exception, match=r"network.filters = 16"):
        frozen.Frozen(Path("x"), WEIGHTS).predictor(NetworkConfig(filters=16))
