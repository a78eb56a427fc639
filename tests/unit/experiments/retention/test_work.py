"""Streams, what strategies keep of them, and what networks learn from that, on a tiny plan."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.plans.plan import Plan, read_plan, stage_config
from experiments.retention import benchmark as benchmark_module
from experiments.retention import work
from experiments.retention.benchmark import Benchmark, Work, config_of, read_benchmark
from experiments.retention.contents import managed
from experiments.retention.refresh import Refresher, Way
from experiments.retention.stream import Recorder, Stream
from experiments.retention.work import Measured
from experiments.runs.run import Run
from shared.errors import StateError
from shared.rl.memory import ReplayMemory
from shared.rl.predictor import Predictor

pytestmark = pytest.mark.timeout(300)

PLAN = """
title = "t"
source = "s"
counted_in = "actions"
episode_actions = 20
[config]
network = { filters = 4 }
memory = { capacity = 60, strategy = "normm", equalise_every = 0 }
learning = { batch_size = 16, mini_batches_per_episode = 0, fit_every_actions = 60, fit_epochs = 1 }
[config.numerics]
actor = { engine = "torch", precision = "float32" }
replay = { device = "cpu", engine = "torch", threads = 1, precision = "float32" }
learner = { device = "cpu", threads = 1, precision = "float32" }
[[stages]]
name = "plus"
until = 100
[[stages]]
name = "minus"
until = 220
[stages.config.robot]
world = "minus"
[evaluation]
starts = 1
actions = 50
every_actions = 1000000
every_starts = 1
every_length = 50
"""
BENCHMARK = """
steps = 6
averaged_steps = 2
marks = ["plus", "minus"]
worlds = ["plus"]
starts = 2
actions = 50
primary_seeds = 2
exploratory_seeds = 1
[[settings]]
name = "tiny"
plan = "stream"
scale = "full"
exploratory = true
[[entries]]
name = "normm"
primary = true
memory = { strategy = "normm" }
[[entries]]
name = "rmm"
memory = { strategy = "rmm" }
networks = 2
refresh = "blend"
refresh_every = 1.2
"""


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> Plan:
    """The plan, in place of the one that is recorded."""
    for module in (work, benchmark_module):
        monkeypatch.setattr(module, "load_plan", lambda *_: TINY)
    return TINY


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording in one go."""
    folder = tmp_path_factory.mktemp("whole")
    recorded(TINY, folder)
    return folder


def with_references(whole: Path, folder: Path) -> Path:
    """The folder with the drives of chance and planner, which take longest."""
    shutil.copytree(whole / "references", folder / "references")
    return folder


TINY = read_plan("stream", PLAN)


def recorded(plan: Plan, folder: Path, *stops: int) -> Run:
    """A run with its stream, stopped after so many turns each time."""
    for turns in (*stops, 10**9):
        seen: list[object] = []
        run = Run(plan, "full", 1, folder / "x" / "run", None, "c", Recorder(folder / "stream"))
        run.go(seen.append, lambda seen=seen, turns=turns: len(seen) >= turns)
        run.close()
    return run


def test_a_stream_gives_the_run_that_it_was_recorded_from(whole: Path) -> None:
    """What the run's own strategy keeps of it is what the run kept, to the last bit."""
    stream, config = Stream(whole / "stream"), stage_config(TINY, 0, 1)
    with np.load(whole / "x" / "run" / "state-end" / "memory.npz") as file:
        rows, images = file["rows"], file["images"]
    last = int(json.loads((whole / "x" / "run" / "run.json").read_text())["episodes"])
    refresher = Refresher("none", stream, config, {})
    (mark,) = managed(stream, config, config.numerics.replay, {last: "minus"}, refresher, 0)
    found = mark.memory.rows.copy()
    for name in set(rows.dtype.names or ()) - {"slot"}:
        np.testing.assert_array_equal(found[name], rows[name], err_msg=name)
    np.testing.assert_array_equal(mark.memory.images(np.arange(len(found))), images)
    assert mark.memory.worlds == ["plus", "minus"]
    assert mark.costs.removed == len(stream.samples) - len(found)


def test_a_recording_that_was_stopped_goes_on(whole: Path, tmp_path: Path) -> None:
    recorded(TINY, with_references(whole, tmp_path), 2, 5, 3)
    for path in sorted((whole / "stream").rglob("*.*")):
        other = tmp_path / path.relative_to(whole)
        assert other.read_bytes() == path.read_bytes(), path.name


def test_what_was_written_after_the_last_snapshot_is_cut_off(whole: Path, tmp_path: Path) -> None:
    seen: list[object] = []
    folder = with_references(whole, tmp_path)
    one = Run(TINY, "full", 1, folder / "x" / "run", None, "c", Recorder(folder / "stream"))
    one.go(seen.append, lambda: len(seen) >= 4)
    one.close()
    for name in ("samples.bin", "images.bin", "turns.bin"):
        with (folder / "stream" / name).open("ab") as file:
            file.write(b"begun")
    recorded(TINY, folder)
    expected, parted = Stream(whole / "stream"), Stream(folder / "stream")
    assert parted.samples.tobytes() == expected.samples.tobytes()
    assert parted.images.tobytes() == expected.images.tobytes()


def test_a_damaged_stream_is_refused(whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole / "stream", tmp_path / "stream")
    path = tmp_path / "stream" / "samples.bin"
    path.write_bytes(path.read_bytes()[:-60])
    with pytest.raises(StateError, match="damaged stream"):
        Stream(tmp_path / "stream")


@pytest.mark.usefixtures("tiny")
def test_everything_is_measured_once(whole: Path, tmp_path: Path) -> None:
    with_references(whole, tmp_path / "streams" / "tiny")
    benchmark = read_benchmark(BENCHMARK)
    setting = benchmark.setting("tiny")
    every = [Work(setting, entry, 1) for entry in benchmark.entries_of(setting, 1)]
    told: list[str] = []
    assert work.measure(benchmark, every, tmp_path, told.append, lambda: False)
    assert told == [
        "tiny, seed 1: recording the stream", "tiny, seed 1: normm", "tiny, seed 1: rmm",
    ]  # fmt: skip
    assert work.measure(benchmark, every, tmp_path, told.append, lambda: True)  # all is done
    assert len(told) == 3
    paths = [work.measured_path(tmp_path, piece) for piece in every]
    one, other = (Measured.model_validate_json(path.read_bytes()) for path in paths)
    assert [(n.mark, n.number) for n in one.networks] == [("plus", 1), ("minus", 1)]
    assert [(n.mark, n.number) for n in other.networks] == [
        ("plus", 1), ("plus", 2), ("minus", 1), ("minus", 2),
    ]  # fmt: skip
    drives = [network.drives["plus"] for network in other.networks]
    assert all(drive["actions"] == 100 for drive in drives)
    held = one.networks[1].contents
    assert held["samples"] <= 60
    assert held["share_plus"] + held["share_minus"] == pytest.approx(1.0, abs=1e-4)
    assert held["column_bytes"] == 0 < other.networks[0].contents["column_bytes"]


@pytest.mark.usefixtures("tiny")
def test_a_stopped_recording_measures_nothing(tmp_path: Path) -> None:
    benchmark = read_benchmark(BENCHMARK)
    setting = benchmark.setting("tiny")
    every = [Work(setting, entry, 1) for entry in benchmark.entries_of(setting, 1)]
    calls: list[int] = []

    def after_the_third() -> bool:
        calls.append(1)
        return len(calls) > 3

    assert not work.measure(benchmark, every, tmp_path, lambda _: None, after_the_third)
    assert not (tmp_path / "measured").exists()


def test_the_memory_itself_refreshes_nothing(tiny: Plan) -> None:
    """That is left to the ways of the benchmark."""
    benchmark: Benchmark = read_benchmark(BENCHMARK)
    for entry in benchmark.entries:
        memory = config_of(tiny, entry, 1).memory
        assert (memory.equalise_every, memory.equalise_every_actions) == (0, 0)


def refreshed(whole: Path, way: Way, losses: dict[int, float], times: int = 1) -> Any:
    """The first samples of a stream, refreshed with its last network: rows before and after."""
    stream, config = Stream(whole / "stream"), stage_config(TINY, 0, 1)
    network = Predictor(config.network, config.numerics.replay)
    refresher, memory = Refresher(way, stream, config, losses), ReplayMemory(200)
    memory.worlds = stream.worlds
    for turn in stream.turns():
        if turn.version != network.version:
            network.load(turn.version, stream.weights(turn.version))
        refresher.note(int(turn.rows["id"][0]) - 1, len(turn.rows), network)
        memory.append(turn.rows, turn.images)
    before = memory.rows.copy()
    for _ in range(times):
        refresher.refresh(memory, network)
    return before, memory.rows, memory, network, refresher


def test_ways_of_refreshing_are_what_they_say(whole: Path) -> None:
    before, none, *_ = refreshed(whole, "none", {})
    np.testing.assert_array_equal(none["reward"], before["reward"])
    before, blend, memory, network, _ = refreshed(whole, "blend", {})
    images = memory.images(np.arange(len(memory)))
    q = np.array(
        [network.values(i[None], a[None])[0] for i, a in zip(images, before["action"], strict=True)]
    )
    once = 0.7 * before["reward"] + 0.3 * q
    np.testing.assert_allclose(blend["reward"], np.clip(once, -1, 1), atol=1e-6)
    _, twice, *_ = refreshed(whole, "blend", {}, times=2)
    np.testing.assert_allclose(twice["reward"], np.clip(0.7 * once + 0.3 * q, -1, 1), atol=1e-6)
    _, anchored, *_ = refreshed(whole, "anchored", {}, times=2)
    np.testing.assert_allclose(anchored["reward"], np.clip(once, -1, 1), atol=1e-6)
    _, protected, *_ = refreshed(whole, "protected", {})
    terminal = before["reward"] == -1.0
    assert terminal.any()
    assert (protected["reward"][terminal] == -1.0).all()
    np.testing.assert_array_equal(protected["reward"][~terminal], blend["reward"][~terminal])


def test_only_the_next_value_is_made_anew(whole: Path) -> None:
    before, after, memory, network, _ = refreshed(whole, "next-value", {})
    terminal = before["reward"] == -1.0
    assert (after["reward"][terminal] == -1.0).all()
    images = memory.images(np.arange(len(memory)))
    changed = 0
    for i in np.flatnonzero(after["reward"] != before["reward"]):
        assert not terminal[i]
        now = network.all_values(images[i + 1][None]).max()
        rest = before["reward"][i] - after["reward"][i] + 0.2 * now
        assert -0.2 - 1e-5 <= rest <= 0.2 + 1e-5  # 0.2 max Q, as it was then
        changed += 1
    assert changed > 50


def test_a_fit_whose_loss_did_not_fall_refreshes_nothing(whole: Path) -> None:
    before, _, _, network, _ = refreshed(whole, "none", {})
    newest = network.version
    for losses, same in (
        ({newest - 1: 0.1, newest: 0.2}, True),
        ({newest - 1: 0.2, newest: 0.1}, False),
        ({newest: 0.1}, True),
        ({}, True),
    ):
        _, after, *_ = refreshed(whole, "better-fits", losses)
        assert (after["reward"].tobytes() == before["reward"].tobytes()) is same
