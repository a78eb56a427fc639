"""Threads and precision are chosen once and then stay."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared import numerics
from shared.config import ActorNumerics, Config, NetworkConfig, Numerics, NumericsConfig
from shared.errors import StateError
from shared.rl.predictor import Predictor

OPEN = Config(
    network=NetworkConfig(filters=4),
    numerics=NumericsConfig(
        actor=ActorNumerics(precision="auto"), replay=Numerics(threads=0, precision="bfloat16")
    ),
)


def test_choice_is_made_once_and_read_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numerics, "_seconds", lambda *_: 0.5)
    first = numerics.settle(OPEN, tmp_path, "actor")
    assert (first.precision, first.threads, first.batch) == ("bfloat16", 1, 1)
    monkeypatch.setattr(numerics, "_seconds", lambda *_: 2.0)
    assert numerics.settle(OPEN, tmp_path, "actor") == first


@pytest.mark.parametrize(("ratio", "precision"), [(0.79, "bfloat16"), (0.81, "float32")])
def test_reduced_precision_must_be_worth_it(
    ratio: float, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numerics, "_seconds", lambda *_: ratio)
    assert numerics.choose(OPEN, OPEN.numerics.actor, "actor").precision == precision


def test_real_measurement_settles(tmp_path: Path) -> None:
    chosen = numerics.settle(OPEN, tmp_path, "actor")
    assert chosen.settled
    replay = numerics.settle(OPEN, tmp_path, "replay")
    assert replay.threads >= 1
    assert replay.precision == "bfloat16"


def test_explicit_numerics_are_taken_as_they_are(tmp_path: Path) -> None:
    assert numerics.settle(Config(), tmp_path, "learner") == Config().numerics.learner
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("text", ["nonsense", '{"threads": "many"}', "[]"])
def test_damaged_choice_is_named(text: str, tmp_path: Path) -> None:
    path = tmp_path / "numerics" / "actor.json"
    path.parent.mkdir()
    path.write_text(text)
    with pytest.raises(StateError, match=r"actor\.json: damaged"):
        numerics.settle(OPEN, tmp_path, "actor")


def test_unsettled_numerics_are_refused_by_the_network() -> None:
    predictor = Predictor(OPEN.network, OPEN.numerics.actor)
    with pytest.raises(ValueError, match="settled"):
        predictor.all_values(__import__("numpy").zeros((1, 50, 75), "uint8"))
