"""Parts of benchmarks that measure real processes, without the processes."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from benchmarks import growth, memory_use, prefilled, transfer
from benchmarks.frame import Mode
from benchmarks.growth import Times
from benchmarks.memory_use import Look
from services.replay.storage import Storage
from shared.config import Config
from shared.messages import ReplayState

ROLLUP = """\
00400000-7fff0000 ---p 00000000 00:00 0                                  [rollup]
Rss:                9000 kB
Shared_Clean:       3000 kB
Private_Clean:      1000 kB
Private_Dirty:      4000 kB
Private_Hugetlb:       7 kB
"""


def test_the_unique_set_size_is_what_no_other_process_maps() -> None:
    assert memory_use.unique_in(ROLLUP) == pytest.approx(5.12)


def test_growth_compares_medians_of_the_first_and_the_last_tenth() -> None:
    used = [100.0, 500.0, 101.0, *[300.0] * 24, 110.0, 111.0, 1.0]
    looks = [Look(actions, {"replay": mb}) for actions, mb in enumerate(used)]
    first, last, percent = memory_use.growth_percent(looks, "replay")
    assert (first, last) == (101.0, 110.0)
    assert percent == pytest.approx(8.91, abs=0.01)


@pytest.mark.parametrize("mode", get_args(Mode))
def test_configurations_of_the_measured_runs_are_valid(mode: Mode) -> None:
    sizes = memory_use.SIZES[mode]
    for capacity, filters in ((sizes.capacity, sizes.filters), (sizes.grow_capacity, 4)):
        config = memory_use.configuration(capacity, filters, 1, sizes.fit_every)
        assert config.memory.capacity == capacity


@pytest.mark.parametrize(
    ("activity", "progress", "expected"),
    [
        ("descriptors", 0.5, True), ("equalising", 0.01, True), ("equalising", 1.0, False),
        ("descriptors", 0.0, False), ("discarding", 0.5, False), ("idle", 1.0, False),
    ],
)  # fmt: skip
def test_only_a_pass_that_has_begun_and_is_not_over_counts(
    activity: str, progress: float, expected: bool
) -> None:
    state = ReplayState.model_construct(activity=activity, progress=progress)
    assert transfer.within_a_pass(state) is expected


def test_a_memory_filled_beforehand_is_full_and_has_the_given_images(tmp_path: Path) -> None:
    config = Config.model_validate({"memory": {"capacity": 500}})
    images = np.full((700, 50, 75), 7, np.uint8)
    assert prefilled.fill(tmp_path, config, images) == 2
    storage = Storage(tmp_path / "replay", config.memory, "demo/1")
    memory = storage.load()
    storage.close()
    assert len(memory) == 500
    assert (memory.images(np.arange(500)) == 7).all()


def test_exponents_are_of_the_whole_and_of_the_steepest_step() -> None:
    assert growth.exponents([1, 10, 100], [1.0, 10.0, 1000.0]) == pytest.approx((1.5, 2.0))


def test_growth_is_drawn(tmp_path: Path) -> None:
    path = tmp_path / "growth.png"
    growth.draw_plot({100: Times(0.1, 0.01, 0.02), 1000: Times(9.0, 0.02, 0.2)}, path)
    assert path.read_bytes().startswith(b"\x89PNG")
