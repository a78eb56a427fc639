"""Kinds of descriptor: what is described anew, and by what."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from builders import FakePredictor, fill_store

from shared.config import MemoryConfig
from shared.rl.descriptor import random_planes, signs_of, thumbnail
from shared.rl.memory import ReplayMemory
from shared.rl.retention.columns import FIXED, KINDS, renew_descriptors
from shared.rl.retention.strategy import Situation, columns

KIND = pytest.mark.parametrize("kind", KINDS)


def memory_of(count: int) -> ReplayMemory:
    memory = ReplayMemory(30)
    fill_store(memory, range(count), [0] * count)
    return memory


def there(memory: ReplayMemory, kind: Any, network: FakePredictor) -> Situation:
    return Situation(memory, 1, MemoryConfig(descriptor=kind), network, seed=5)


@KIND
def test_each_kind_has_its_source(kind: str) -> None:
    memory = memory_of(5)
    assert renew_descriptors(there(memory, kind, FakePredictor(4)))
    images = memory.images(np.arange(5))
    front = images.reshape(5, -1)
    expected = {
        "maps": front[:, :15],
        "first-maps": front[:, :15],
        "fconn1": front[:, 15:30],
        "thumbnail": thumbnail(images),
        "simhash": signs_of(images, random_planes(5)),
    }
    assert np.array_equal(memory.rows["descriptor"], expected[kind])


@KIND
def test_other_weights_renew_only_what_depends_on_them(kind: str) -> None:
    memory, network = memory_of(5), FakePredictor(4)
    renew_descriptors(there(memory, kind, network))
    assert not renew_descriptors(there(memory, kind, network))
    network.version = 5
    assert renew_descriptors(there(memory, kind, network)) == (kind not in FIXED)


def test_first_maps_ask_the_network_of_version_1() -> None:
    memory, network = memory_of(5), FakePredictor(4)
    renew_descriptors(there(memory, "first-maps", network))
    assert network.described == []
    assert network.first(5).version == 1
    assert network.first(5).described == [5]


@KIND
def test_another_kind_is_never_taken_for_this_one(kind: str) -> None:
    for other in KINDS:
        memory = memory_of(3)
        renew_descriptors(there(memory, other, FakePredictor(1)))
        assert renew_descriptors(there(memory, kind, FakePredictor(1))) == (kind != other)


def test_descriptors_of_maps_are_stamped_with_the_version_alone() -> None:
    memory = memory_of(2)
    renew_descriptors(there(memory, "maps", FakePredictor(9)))
    assert memory.rows["described_by"].tolist() == [9, 9]


def test_shared_columns_are_there_once() -> None:
    names = [name for name, *_ in columns()]
    assert len(names) == len(set(names))
    assert names[:5] == ["descriptor", "described_by", "candidate", "forced", "marked_by"]
