"""Device, engine, threads and precision are chosen once and then stay."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from shared import numerics, settings
from shared.config import (
    ActorNumerics,
    Config,
    LearnerNumerics,
    NetworkConfig,
    Numerics,
    NumericsConfig,
)
from shared.errors import ConfigError, StateError
from shared.rl.predictor import Predictor

OPEN = Config(
    network=NetworkConfig(filters=4),
    numerics=NumericsConfig(
        actor=ActorNumerics(precision="auto"), replay=Numerics(threads=0, precision="bfloat16")
    ),
)


def test_choice_is_made_once_and_read_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numerics, "_seconds", lambda *_: [1.0, 0.5])
    first = numerics.settle(OPEN, tmp_path, "actor")
    assert (first.precision, first.threads, first.batch) == ("bfloat16", 1, 1)
    monkeypatch.setattr(numerics, "_seconds", lambda *_: [1.0, 2.0])
    assert numerics.settle(OPEN, tmp_path, "actor") == first


def test_runs_beside_each_other_compute_alike(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """L8: near a tie, two measurements choose differently."""
    times = iter([[1.0, 0.79], [1.0, 0.81]])
    monkeypatch.setattr(numerics, "_seconds", lambda *_: next(times))
    common = tmp_path / "common"
    first = numerics.settle(OPEN, tmp_path / "one", "actor", common)
    assert first.precision == "bfloat16"
    assert numerics.settle(OPEN, tmp_path / "two", "actor", common) == first
    assert numerics.settle(OPEN, tmp_path / "two", "actor") == first  # its own from now on
    assert numerics.settle(OPEN, tmp_path / "alone", "actor").precision == "float32"


def test_of_two_that_measure_at_once_the_first_wins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    times = iter([[1.0, 0.81], [1.0, 0.79]])

    def overtaken(*_: object) -> list[float]:
        mine = next(times)
        if mine[1] > 0.8:  # another process settles while this one measures
            numerics.settle(OPEN, tmp_path, "actor")
        return mine

    monkeypatch.setattr(numerics, "_seconds", overtaken)
    assert numerics.settle(OPEN, tmp_path, "actor").precision == "bfloat16"
    assert [path.name for path in (tmp_path / "numerics").iterdir()] == ["actor.json"]


@pytest.mark.parametrize(("ratio", "precision"), [(0.79, "bfloat16"), (0.81, "float32")])
def test_reduced_precision_must_be_worth_it(
    ratio: float, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numerics, "_seconds", lambda *_: [1.0, ratio])
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
    with pytest.raises(ValueError, match="settled"):
        Predictor(OPEN.network, OPEN.numerics.actor)


@pytest.mark.parametrize(
    ("times", "engine", "precision"),
    [
        ([1.0, 0.9, 0.9, 0.9], "torch", "float32"),
        ([1.0, 0.7, 0.6, 0.5], "openvino", "bfloat16"),
        ([1.0, 0.4, 0.6, 0.5], "openvino", "float32"),
        ([1.0, 0.9, 0.3, 0.5], "torch", "bfloat16"),
    ],
)
def test_the_fastest_engine_and_precision_are_chosen_together(
    times: list[float], engine: str, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numerics, "_seconds", lambda *_: times)
    monkeypatch.setattr(numerics, "_has_openvino", lambda: True)
    chosen = numerics.choose(OPEN, Numerics(engine="auto", precision="auto"), "replay")
    assert (chosen.engine, chosen.precision) == (engine, precision)


def test_an_engine_that_is_missing_is_never_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numerics, "_has_openvino", lambda: False)
    assert numerics.choose(OPEN, Numerics(engine="auto"), "replay").engine == "torch"
    with pytest.raises(ConfigError, match=r"'openvino' is not installed.*corridor\[openvino\]"):
        numerics.choose(OPEN, Numerics(engine="openvino", threads=0), "replay")


@pytest.mark.parametrize(("gpu", "device"), [(True, "cuda"), (False, "cpu")])
def test_a_gpu_is_taken_where_there_is_one(
    gpu: bool, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numerics, "_has_gpu", lambda: gpu)
    monkeypatch.setattr(numerics, "_seconds", lambda *_: [1.0])
    wanted = LearnerNumerics(device="auto", threads=0)
    assert not wanted.settled
    chosen = numerics.choose(OPEN, wanted, "learner")
    assert (chosen.device, chosen.settled) == (device, True)
    assert chosen.threads == 1 or not gpu
    assert chosen.images_per_pass == (2048 if gpu else wanted.batch)


def test_the_learner_is_measured_by_training(tmp_path: Path) -> None:
    chosen = numerics.choose(OPEN, LearnerNumerics(precision="auto", threads=0), "learner")
    assert chosen.settled


# ------------------------------------------------------------------ accelerators that fail


BROKEN = """import json, os, pathlib, signal, sys, time
folder, left_out, *roles = sys.argv[1:]
os.write(1, b"trying plain\\n")
if "openvino" not in json.loads(left_out):
    os.write(1, b"trying openvino\\n")
    {ends}
for role in roles:
    path = pathlib.Path(folder, "numerics", role + ".json")
    path.parent.mkdir(exist_ok=True)
    path.write_text("{{}}")
"""
UNSETTLED = Config(numerics=NumericsConfig(actor=ActorNumerics(engine="auto")))


@pytest.mark.parametrize(
    ("ends", "told"),
    [
        ("os.kill(os.getpid(), signal.SIGILL)", "SIGILL"),
        ("raise ImportError('no AVX here')", "ImportError: no AVX here"),
        ("time.sleep(60)", "it took longer than 1 s"),
    ],
)
def test_an_accelerator_that_fails_is_left_out_and_named_once(
    ends: str,
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    command = (sys.executable, "-S", "-c", BROKEN.format(ends=ends))
    monkeypatch.setattr(numerics, "COMMAND", command)
    if "sleep" in ends:
        monkeypatch.setattr(numerics, "TRY_S", 1.0)
    numerics.settle_all(UNSETTLED, tmp_path)
    assert (tmp_path / "numerics" / "actor.json").exists()
    assert [record.getMessage() for record in caplog.records] == [
        f"numerics: openvino does not work here and is left out: {told}"
    ]


def test_it_tells_what_it_measures_and_ends_at_once_when_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = (sys.executable, "-S", "-c", BROKEN.format(ends="time.sleep(60)"))
    monkeypatch.setattr(numerics, "COMMAND", command)
    monkeypatch.setattr(numerics, "NEWS_S", 0.0)
    told: list[str] = []
    tried = "actor, openvino"
    numerics.settle_all(
        UNSETTLED, tmp_path, tell=told.append, stopped=lambda: tried in told[-1] if told else False
    )
    assert "loading libraries" in told[0]
    assert tried in told[-1]
    assert not list(tmp_path.iterdir())


def test_what_fails_without_an_accelerator_is_told_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = (sys.executable, "-c", "raise OSError('libtorch.so: no such file')")
    monkeypatch.setattr(numerics, "COMMAND", command)
    with pytest.raises(ConfigError, match=r"actor cannot be settled here: OSError: libtorch\.so"):
        numerics.settle_all(UNSETTLED, tmp_path)


def test_an_openvino_that_dies_leaves_torch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A processor without the instructions it was built for: SIGILL when it is imported."""
    (tmp_path / "openvino").mkdir()
    dies = "import os, signal\nos.kill(os.getpid(), signal.SIGILL)\n"
    (tmp_path / "openvino" / "__init__.py").write_text(dies)
    config = UNSETTLED.model_copy(update={"network": NetworkConfig(filters=4)})
    folder = tmp_path / "run"
    settings.claim(folder, config)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{Path(numerics.__file__).parents[1]}")
    numerics.settle_all(config, folder)
    assert numerics.settle(config, folder, "actor").engine == "torch"
    assert "openvino does not work here and is left out: SIGILL" in caplog.text


def test_what_failed_is_not_tried_again_alone_or_together(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(numerics, "_left_out", ["openvino", "cuda bfloat16"])
    allowed = [name for name in NAMES if numerics._may_try(name)]
    assert allowed == ["plain", "bfloat16", "cuda"]
    assert capfd.readouterr().out.splitlines() == [f"trying {name}" for name in NAMES]


NAMES = ("plain", "bfloat16", "openvino", "openvino bfloat16", "cuda", "cuda bfloat16")
