"""Checkpoints: everything comes back, and nothing that does not fit is taken."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from builders import fill_store
from safetensors import safe_open
from safetensors.torch import save

from services.learner import checkpoint
from services.learner.history import Place
from shared.config import LearningConfig, NetworkConfig, Numerics
from shared.errors import StateError
from shared.rl.learning import Trainer
from shared.rl.memory import SampleStore
from shared.rl.network import to_bytes
from shared.rl.schedule import Moment

torch.set_num_threads(1)
IDENTITY = "run1/0123456789abcdef"


def make_trainer(filters: int = 4) -> Trainer:
    learning = LearningConfig(batch_size=4, target_rule="bump")
    return Trainer(NetworkConfig(filters=filters), learning, Numerics(batch=4), 1)


def train(trainer: Trainer, episodes: range) -> None:
    store = SampleStore()
    fill_store(store, range(1, 9), [0, 1, 2] * 2 + [0, 1], np.linspace(-1, 1, 8).tolist())
    for episode in episodes:
        list(trainer.learn(store, Moment(episode)))
        trainer.apply_target_rule(episode, bump=episode % 2 == 0)


def state(trainer: Trainer) -> tuple[bytes, bytes, dict[str, int]]:
    return (to_bytes(trainer.train_network), to_bytes(trainer.target_network), trainer.counters())


@pytest.fixture
def written(tmp_path: Path) -> tuple[Path, Trainer]:
    path, trainer = tmp_path / "learner" / "checkpoint.safetensors", make_trainer()
    train(trainer, range(1, 4))
    checkpoint.write(path, trainer, 3, IDENTITY)
    return path, trainer


def test_a_restored_trainer_continues_bit_for_bit(written: tuple[Path, Trainer]) -> None:
    path, trainer = written
    resumed = make_trainer()
    assert checkpoint.read(path, resumed, IDENTITY).episode == 3
    assert state(resumed) == state(trainer)
    train(trainer, range(4, 7))
    train(resumed, range(4, 7))
    assert state(resumed) == state(trainer)


def test_an_untrained_trainer_can_be_saved_too(tmp_path: Path) -> None:
    path, trainer = tmp_path / "checkpoint", make_trainer()
    checkpoint.write(path, trainer, 0, IDENTITY)
    resumed = make_trainer()
    assert checkpoint.read(path, resumed, IDENTITY).episode == 0
    train(trainer, range(1, 4))
    train(resumed, range(1, 4))
    assert state(resumed) == state(trainer)


def test_without_a_file_the_trainer_stays_as_it_is(tmp_path: Path) -> None:
    trainer = make_trainer()
    before = state(trainer)
    assert checkpoint.read(tmp_path / "none", trainer, IDENTITY).episode == 0
    assert state(trainer) == before


def test_the_newer_checkpoint_takes_the_place_of_the_older(written: tuple[Path, Trainer]) -> None:
    path, trainer = written
    train(trainer, range(4, 5))
    checkpoint.write(path, trainer, 4, IDENTITY)
    assert checkpoint.read(path, make_trainer(), IDENTITY).episode == 4
    assert sorted(p.name for p in path.parent.iterdir()) == [path.name, f"{path.name}.previous"]


def test_a_half_written_newer_file_is_ignored(written: tuple[Path, Trainer]) -> None:
    path, trainer = written
    path.with_name(path.name + ".new").write_bytes(path.read_bytes()[:1000])
    resumed = make_trainer()
    assert checkpoint.read(path, resumed, IDENTITY).episode == 3
    assert state(resumed) == state(trainer)
    checkpoint.write(path, trainer, 4, IDENTITY)
    assert checkpoint.read(path, make_trainer(), IDENTITY).episode == 4


def test_a_checkpoint_of_another_run_is_refused(written: tuple[Path, Trainer]) -> None:
    trainer = make_trainer()
    before = state(trainer)
    with pytest.raises(StateError, match="run2"):
        checkpoint.read(written[0], trainer, "run2/0123456789abcdef")
    assert state(trainer) == before


def test_a_checkpoint_of_another_schema_is_refused(
    written: tuple[Path, Trainer], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoint, "SCHEMA", 999)
    with pytest.raises(StateError, match="999"):
        checkpoint.read(written[0], make_trainer(), IDENTITY)


def test_a_checkpoint_of_a_wider_network_is_refused(written: tuple[Path, Trainer]) -> None:
    with pytest.raises(StateError, match="damaged checkpoint"):
        checkpoint.read(written[0], make_trainer(filters=8), IDENTITY)


@pytest.mark.parametrize("keep", [0, 1, 7, 8, 100, 5000, -1])
def test_a_truncated_checkpoint_is_told_as_damaged(
    written: tuple[Path, Trainer], keep: int
) -> None:
    path, _ = written
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(StateError, match="damaged checkpoint"):
        checkpoint.read(path, make_trainer(), IDENTITY)


@pytest.mark.parametrize(
    "header",
    [
        None,
        {},
        {"state": "not json"},
        {"state": "[1]"},
        {"state": json.dumps({"schema": 1})},
        {"state": json.dumps({"schema": 1, "identity": IDENTITY, "episode": 3})},
        {"state": json.dumps({"schema": 1, "identity": IDENTITY, "episode": 3, "counters": {}})},
    ],
    ids=["none", "empty", "text", "list", "no identity", "no counters", "empty counters"],
)
def test_a_damaged_header_is_told_as_such(
    written: tuple[Path, Trainer], header: dict[str, str] | None
) -> None:
    path, trainer = written
    tensors = {name: t.contiguous() for name, t in trainer.tensors().items()}
    path.write_bytes(save(tensors, header))
    with pytest.raises(StateError, match="damaged checkpoint"):
        checkpoint.read(path, make_trainer(), IDENTITY)


@pytest.mark.parametrize("name", ["train.out.bias", "target.conv1.weight", "square_avg.out.bias"])
def test_a_missing_tensor_is_told_by_its_name(written: tuple[Path, Trainer], name: str) -> None:
    path, trainer = written
    with safe_open(path, framework="pt") as file:
        header = file.metadata()
    tensors = {n: t.contiguous() for n, t in trainer.tensors().items() if n != name}
    path.write_bytes(save(tensors, header))
    with pytest.raises(StateError, match=name.replace(".", r"\.")):
        checkpoint.read(path, make_trainer(), IDENTITY)


# ------------------------------------------------------------------------- what goes wrong


def test_the_lineage_comes_back_and_an_older_file_has_none(written: tuple[Path, Trainer]) -> None:
    path, trainer = written
    checkpoint.write(path, trainer, 4, IDENTITY, "ab" * 8)
    assert checkpoint.read(path, make_trainer(), IDENTITY) == Place(4, "ab" * 8)
    with safe_open(path, framework="pt") as file:
        header = json.loads(file.metadata()["state"])
    del header["lineage"]
    tensors = {name: t.contiguous() for name, t in trainer.tensors().items()}
    path.write_bytes(save(tensors, {"state": json.dumps(header)}))
    assert checkpoint.read(path, make_trainer(), IDENTITY) == Place(4, "")


@pytest.mark.parametrize("name", ["train.out.bias", "target.conv1.weight", "square_avg.out.bias"])
def test_numbers_that_are_not_finite_leave_the_last_good_checkpoint(
    written: tuple[Path, Trainer], name: str
) -> None:
    path, trainer = written
    before = path.read_bytes()
    with torch.no_grad():
        trainer.tensors()[name].view(-1)[0] = math.nan
    with pytest.raises(FloatingPointError, match=f"{name} is not finite"):
        checkpoint.write(path, trainer, 4, IDENTITY)
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    tensors = {n: t.contiguous() for n, t in trainer.tensors().items()}
    with safe_open(path, framework="pt") as file:
        header = file.metadata()
    path.write_bytes(save(tensors, header))
    with pytest.raises(checkpoint.Damaged, match=f"{name} is not finite"):
        checkpoint.read(path, make_trainer(), IDENTITY)


def test_an_unreadable_checkpoint_is_kept_and_the_one_before_taken(
    written: tuple[Path, Trainer],
) -> None:
    path, trainer = written
    checkpoint.write(path, trainer, 4, IDENTITY)
    path.write_bytes(path.read_bytes()[:-1])
    damaged = path.read_bytes()
    with pytest.raises(
        StateError, match=r"damaged.*unreadable-1 now, and the next start goes on from the one bef"
    ):
        checkpoint.take_up(path, make_trainer(), IDENTITY)
    assert path.with_name(f"{path.name}.unreadable-1").read_bytes() == damaged
    assert checkpoint.take_up(path, make_trainer(), IDENTITY).episode == 3
    path.write_bytes(b"")
    with pytest.raises(StateError, match=r"unreadable-2 now, and the next start begins with new"):
        checkpoint.take_up(path, make_trainer(), IDENTITY)
    assert checkpoint.take_up(path, make_trainer(), IDENTITY) == Place()
    assert path.with_name(f"{path.name}.unreadable-1").read_bytes() == damaged


def test_a_checkpoint_of_another_run_stays_where_it_is(written: tuple[Path, Trainer]) -> None:
    path, _ = written
    with pytest.raises(StateError, match="run2"):
        checkpoint.take_up(path, make_trainer(), "run2/0123456789abcdef")
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_a_kill_costs_no_turn_and_a_power_cut_those_since_the_last_sync(
    written: tuple[Path, Trainer], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, trainer = written
    on_disk = path.read_bytes()
    for episode in (4, 5):
        train(trainer, range(episode, episode + 1))
        checkpoint.keep(path, trainer, episode, IDENTITY)
    assert path.read_bytes() == on_disk
    files = {file.name: file.read_bytes() for file in path.parent.iterdir()}
    with monkeypatch.context() as other:
        other.setattr(checkpoint, "_boot", lambda: "after a power cut")
        assert checkpoint.take_up(path, make_trainer(), IDENTITY).episode == 3
    for name, data in files.items():
        (path.parent / name).write_bytes(data)
    (path.parent / f"{path.name}{checkpoint.UNSYNCED[0]}").write_bytes(b"torn")  # while 6 was
    resumed = make_trainer()
    assert checkpoint.take_up(path, resumed, IDENTITY).episode == 5
    assert state(resumed) == state(trainer)
    assert {file.name for file in path.parent.iterdir()} == {path.name, path.name + ".previous"}


def test_without_a_checkpoint_a_state_that_was_not_synced_does_not_count(
    written: tuple[Path, Trainer],
) -> None:
    path, trainer = written
    checkpoint.keep(path, trainer, 4, IDENTITY)
    path.unlink()
    assert checkpoint.take_up(path, make_trainer(), IDENTITY) == Place()
