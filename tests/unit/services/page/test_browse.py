"""The memory to look at: filters, neighbours, what was discarded and why; images stay on disk."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import FakePredictor, images_with, make_config, make_episode

from services.page.browse import Browser, Query, nearest
from services.replay.storage import Storage
from services.replay.tables import MARKS
from shared import settings
from shared.errors import StateError
from shared.rl.memory import SAMPLE
from shared.rl.schedule import Moment
from shared.rl.turn import maintain

CONFIG = make_config(
    memory={"capacity": 30, "fill": "none", "equalise_every": 2, "threshold_percent": 1}
)


def drive(run: Path, *seeds: int, count: int = 10) -> None:
    """Episodes of images that all look alike: descriptors differ in the last byte alone."""
    storage = Storage(run / "replay", CONFIG.memory, "run/1")
    memory, predictor = storage.load(), FakePredictor()
    for seed in seeds:
        fronts = [bytes(14) + bytes([seed % 2]) + bytes([seed, i]) for i in range(count)]
        actions = (np.arange(count) % 3).astype(np.uint8).tobytes()
        images = images_with(fronts)
        world = "plus" if seed < 3 else "minus"
        given = {"sample_actions": actions, "worlds": (world,)}
        storage.commit(make_episode(count, seed=seed, images=images, **given))
        pending = storage.pending(storage.position().processed)
        assert pending is not None
        memory.worlds = pending.worlds
        memory.append(pending.rows, pending.images)
        now = Moment(pending.commit.episode)
        done = maintain(memory, now, CONFIG.memory, predictor, seed=1)  # type: ignore[arg-type]
        storage.apply_turn(pending, memory, done)
    storage.close()


@pytest.fixture
def run(tmp_path: Path) -> Path:
    settings.write(CONFIG, tmp_path / settings.FILE_NAME)
    return tmp_path


@pytest.fixture
def browser(run: Path, monkeypatch: pytest.MonkeyPatch) -> Browser:
    """Whose other process is this one."""
    found = Browser(run)

    def here(work: Any, *values: Any) -> Any:
        return work(*values)

    monkeypatch.setattr(found, "_elsewhere", here)
    return found


def test_a_run_without_a_memory_says_so(browser: Browser) -> None:
    with pytest.raises(StateError, match="expected a replay memory"):
        browser.overview(Query())


def test_what_is_in_the_memory_is_counted_and_found(browser: Browser, run: Path) -> None:
    drive(run, 1, 2)
    told = browser.overview(Query())
    assert (told["size"], told["capacity"], told["turn"]) == (20, 30, 2)
    assert told["by_action"] == [8, 6, 6]
    assert (told["worlds"], told["described"], told["fill"]) == ({"plus": 20}, 0, 0)
    browser._open().env.close()
    drive(run, 3)
    browser._tables = None
    assert browser.overview(Query())["worlds"] == {"plus": 20, "minus": 10}

    def count(**wanted: Any) -> int:
        return int(browser.samples(Query(**wanted))["count"])

    assert (count(), count(action=0), count(world="minus"), count(world="x")) == (30, 12, 10, 0)
    assert count(youngest=1, oldest=1) == 10
    assert count(least=-1.0, most=0.0) + count(least=0.0, most=1.0) == 30
    assert (count(candidate=True), count(candidate=False), count(page=9)) == (0, 30, 30)
    newest = browser.samples(Query(action=1))["samples"][0]
    assert (newest["id"], newest["action"], newest["episode"]) == (28, 1, 3)
    assert browser.samples(Query(page=1))["samples"] == []


def test_what_was_discarded_is_shown_with_what_it_was_most_like(
    browser: Browser, run: Path
) -> None:
    drive(run, 1, 2, 3, 4)
    gone = browser.discard(Query())
    assert gone["count"] > 0
    assert sum(gone["reasons"].values()) == gone["count"] == len(gone["samples"])
    first = gone["samples"][0]
    assert (first["why"], first["like"]["bits"]) == ("alike", 0)
    assert first["like"]["id"] > first["id"]
    detail = browser.sample(Query(id=first["id"]))
    assert (detail["there"], detail["candidate"], len(detail["descriptor"])) == (False, True, 120)


def test_a_sample_tells_where_it_comes_from_and_what_it_is_like(
    browser: Browser, run: Path
) -> None:
    drive(run, 1, 2, 3, 4)
    wanted = browser.samples(Query(action=2))["samples"][-1]["id"]
    told = browser.sample(Query(id=wanted))
    assert told["there"]
    assert (told["robot"], told["action"], told["ended"]) == ("robot1", 2, "bump")
    assert told["reward_observed"] != told["reward"]  # equalised meanwhile
    bits = [each["bits"] for each in told["neighbours"]]
    assert bits == sorted(bits)
    assert all(each["action"] == 2 and each["id"] != wanted for each in told["neighbours"])
    with pytest.raises(StateError, match="missing"):
        browser.sample(Query(id=10_000))


def test_a_threshold_marks_what_the_search_of_the_run_would_mark(
    browser: Browser, run: Path
) -> None:
    drive(run, 1, 2, 3, 4)
    counts = [browser.samples(Query(bits=bits))["count"] for bits in (0, 1, 120)]
    size = browser.overview(Query())["described"]
    assert 0 < counts[0] <= counts[1] <= counts[2] == size - 3  # the newest of each action stays


def test_nearest_compares_descriptors_of_one_version_and_prefers_the_newest() -> None:
    rows = np.zeros(5, SAMPLE)
    rows["id"], rows["action"], rows["described_by"] = np.arange(1, 6), 1, 1
    rows["descriptor"][0, 0], rows["descriptor"][3, 0] = 0b111, 0b1
    rows["action"][4], rows["described_by"][2] = 2, 2
    mark = np.zeros(1, MARKS)[0]
    mark["id"], mark["described_by"] = 9, 1
    places, bits = nearest(mark, 1, rows, 5)
    assert (places.tolist(), bits.tolist()) == ([1, 3, 0], [0, 1, 3])
    mark["described_by"] = 0
    assert len(nearest(mark, 1, rows, 5)[0]) == 0


def test_predictions_come_from_a_process_of_their_own(run: Path) -> None:
    from services.learner import checkpoint
    from shared.rl.learning import Trainer

    config = settings.read_folder(run)
    trainer = Trainer(config.network, config.learning, config.numerics.learner, 1)
    checkpoint.write(run / "learner" / "checkpoint.safetensors", trainer, 3, "x")
    drive(run, 1)
    browser = Browser(run)
    try:
        told = browser.prediction(Query(id=1))
    finally:
        browser.end()
    assert (len(told["values"]), told["episode"]) == (3, 3)


def test_the_page_needs_no_torch() -> None:
    code = "import services.page.service, sys; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
