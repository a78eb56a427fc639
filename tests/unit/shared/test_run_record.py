"""One record of a run, whoever writes it: begun once, tables joined, other tables refused."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from types import SimpleNamespace

import pytest
from builders import make_images
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from shared import run_record
from shared.config import Config
from shared.errors import DiskFull
from shared.metrics import MetricsLog
from shared.rl.network import initialised
from shared.run_record import EPISODE_COLUMNS, REPLAY_COLUMNS, TRAINING_COLUMNS, RunInfo


def test_a_run_of_the_services_is_recorded_as_it_begins_and_never_again(tmp_path: Path) -> None:
    config = Config.model_validate({"run": {"name": "first", "seed": 7}})
    run_record.begin(tmp_path, config)
    written = (tmp_path / "run.json").read_bytes()
    info = RunInfo.model_validate_json(written)
    assert (info.experiment, info.scale, info.seed) == ("first", "services", 7)
    assert [(stage.world, stage.first_episode) for stage in info.stages] == [("plus", 1)]
    assert all((info.command, info.commit, info.machine, info.python, info.torch, info.started))
    run_record.begin(tmp_path, config)
    assert (tmp_path / "run.json").read_bytes() == written


def test_what_the_learner_wrote_is_joined_by_episode(tmp_path: Path) -> None:
    rows = [dict.fromkeys(REPLAY_COLUMNS, "1") | {"episode": n} for n in (1, 2)]
    run_record.write_csv(tmp_path / "episodes.csv", REPLAY_COLUMNS, rows)
    first, second = run_record.read_episodes(tmp_path)
    assert first["loss"] == ""  # the learner has not come that far
    training = dict.fromkeys(TRAINING_COLUMNS, "3") | {"episode": 2, "loss": 0.5}
    run_record.write_csv(tmp_path / "training.csv", TRAINING_COLUMNS, [training])
    first, second = run_record.read_episodes(tmp_path)
    assert (first["loss"], second["loss"], second["train_steps"]) == ("", "0.5", "3")
    assert set(EPISODE_COLUMNS) <= second.keys()


@pytest.mark.parametrize("header", ["", "stage,episode", "episode,colour"])
def test_a_table_of_another_schema_is_refused(tmp_path: Path, header: str) -> None:
    (tmp_path / "episodes.csv").write_text(f"{header}\n")
    with pytest.raises(ValueError, match=r"episodes\.csv: expected the columns episode, stage"):
        run_record.read_episodes(tmp_path)


def test_on_a_full_disk_a_table_gets_all_of_a_row_or_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = dict.fromkeys(TRAINING_COLUMNS, "1")
    with pytest.raises(DiskFull, match="disk full: /dev/full"):
        run_record.append_csv(Path("/dev/full"), TRAINING_COLUMNS, [row])
    path = tmp_path / "training.csv"
    run_record.append_csv(path, TRAINING_COLUMNS, [row])
    before = path.read_bytes()
    with monkeypatch.context() as full:
        full.setattr(os, "fsync", lambda _: os.write(os.open("/dev/full", os.O_WRONLY), b"x"))
        with pytest.raises(DiskFull):
            run_record.write_csv(path, TRAINING_COLUMNS, [row] * 1000)
    assert (path.read_bytes(), os.listdir(tmp_path)) == (before, ["training.csv"])
    torn = SimpleNamespace(tell=lambda: 7, write=lambda data: len(data) - 1, truncate=cut.append)
    with monkeypatch.context() as full:
        full.setattr(Path, "open", lambda *_, **__: contextlib.nullcontext(torn))
        with pytest.raises(DiskFull):
            run_record.append_csv(path, TRAINING_COLUMNS, [row])
    assert cut == [7]


def test_tensorboard_shows_ever_fewer_episodes_and_a_full_disk_stops_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    metrics, shown = MetricsLog(tmp_path / "training.csv", TRAINING_COLUMNS), []
    monkeypatch.setattr(metrics, "_show", lambda episode, _: shown.append(episode))
    monkeypatch.setattr("shared.metrics.append_csv", lambda *_: None)
    for episode in range(1, 100_001):
        metrics.write({"episode": episode})
    assert shown[:4096] == list(range(1, 4097))
    assert 4096 < len(shown) < 16_000
    monkeypatch.setattr(metrics, "_show", fails)
    metrics.write({"episode": 1})
    assert "TensorBoard lacks episode 1: no space" in caplog.text


cut: list[int] = []


def fails(*_: object) -> None:
    raise OSError("no space")


def test_tensorboard_has_settings_weights_and_what_is_predicted_for_images(tmp_path: Path) -> None:
    config = Config.model_validate({"network": {"filters": 4}})
    metrics = MetricsLog(tmp_path / "training.csv", TRAINING_COLUMNS, config)
    metrics.show_network(5, initialised(config.network, seed=1), make_images(3))
    metrics.close()
    found = EventAccumulator(str(tmp_path / "tensorboard" / "training")).Reload()
    assert "weights/conv1.weight" in found.Tags()["histograms"]
    (probes,) = found.Images("probes")
    assert (probes.width, probes.height) == (3 * 75, 50 + 3 * 6)
    data = found.summary_metadata["_hparams_/session_start_info"].plugin_data.content
    assert b"network.filters" in data
