"""Reward equalisation against Eq 3.5 (A35, E24, E25)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from builders import FakePredictor, fake_values, fill_store
from hypothesis import given, settings
from hypothesis import strategies as st

from shared.config import MemoryConfig
from shared.rl import memory as memory_module
from shared.rl.memory import ReplayMemory
from shared.rl.reward import equalised
from shared.rl.schedule import Moment
from shared.rl.turn import maintain

FAST = settings(deadline=None, max_examples=80, derandomize=True)
reward = st.one_of(st.just(-1.0), st.just(1.0), st.floats(-1.0, 1.0, width=32))


@FAST
@given(st.lists(st.tuples(reward, reward), max_size=30), st.floats(0.0, 1.0), st.booleans())
def test_equalised_rewards_equal_the_equation(
    pairs: list[tuple[float, float]], keep: float, protect: bool
) -> None:
    config = MemoryConfig(equalise_keep=keep, protect_terminal=protect)
    rewards = np.array([r for r, _ in pairs], np.float32)
    values = np.array([q for _, q in pairs], np.float32)
    found = equalised(rewards, values, config)
    assert found.dtype == np.float32
    for (r, q), new in zip(pairs, found, strict=True):
        expected = r if protect and r == -1.0 else max(-1.0, min(1.0, keep * r + (1 - keep) * q))
        assert float(new) == pytest.approx(expected, abs=1e-6)
        assert -1.0 <= new <= 1.0


def test_constants_are_those_of_the_thesis() -> None:
    found = equalised(np.array([0.5], np.float32), np.array([-0.5], np.float32), MemoryConfig())
    assert found[0] == pytest.approx(0.7 * 0.5 - 0.3 * 0.5)
    assert MemoryConfig().equalise_every == 50


def test_terminal_rewards_drift_unless_protected() -> None:
    terminal, value = np.array([-1.0], np.float32), np.array([0.0], np.float32)
    assert equalised(terminal, value, MemoryConfig())[0] == pytest.approx(-0.7)
    assert equalised(terminal, value, MemoryConfig(protect_terminal=True))[0] == -1.0


@pytest.mark.parametrize(
    ("episode", "expected"), [(0, False), (49, False), (50, True), (51, False)]
)
def test_every_sample_of_the_memory_is_equalised_when_due(episode: int, expected: bool) -> None:
    memory = ReplayMemory(30)
    fill_store(memory, range(1, 8), [0, 1, 2, 0, 1, 2, 0], [-1.0, 0.1, 0.2, 0.3, 0.4, 0.5, 1.0])
    before = memory.rows["reward"].tolist()
    predictor = FakePredictor(version=4)
    done = maintain(memory, Moment(episode), MemoryConfig(capacity=30), predictor, seed=1)  # type: ignore[arg-type]
    assert done.equalised is expected
    for rank, old in enumerate(before):
        image = memory.images(np.array([rank]))[0].tobytes()
        value = fake_values(image, 4)[int(memory.rows["action"][rank])]
        wanted = 0.7 * old + 0.3 * value if expected else old
        assert memory.rows["reward"][rank] == pytest.approx(wanted, abs=1e-6)


def test_an_empty_memory_is_not_equalised() -> None:
    memory, config = ReplayMemory(30), MemoryConfig(capacity=30)
    done = maintain(memory, Moment(50), config, FakePredictor(), seed=1)  # type: ignore[arg-type]
    assert not done.equalised


def test_what_is_discarded_is_not_equalised_and_what_remains_is() -> None:
    """E25: discard comes before equalisation."""
    memory = ReplayMemory(30)
    config = MemoryConfig(capacity=30, strategy="normm", equalise_every=1)
    fill_store(memory, range(1, 32), [0] * 31, [0.5] * 31)
    done = maintain(memory, Moment(1), config, FakePredictor(), seed=1)  # type: ignore[arg-type]
    assert list(done.discarded.ids) == [1, 2]
    assert done.equalised
    assert (memory.rows["reward"] != 0.5).all()


class Talkative(FakePredictor):
    """Reports each image it looks at."""

    def values(self, images: Any, actions: Any, progress: Any = None) -> Any:
        for done in range(len(images)):
            progress(done + 1, len(images))
        return super().values(images, actions)

    def descriptors(self, images: Any, progress: Any = None) -> Any:
        for done in range(len(images)):
            progress(done + 1, len(images))
        return super().descriptors(images)


@pytest.mark.parametrize("part", [1, 7, 1024])
def test_a_pass_sees_some_images_at_a_time_and_reports_how_much_of_all(
    part: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All images at once would be as large as the memory itself."""
    monkeypatch.setattr(memory_module, "PART", part)
    memory, predictor = ReplayMemory(30), Talkative(version=4)
    fill_store(memory, range(1, 32), [0] * 31, [0.5] * 31)
    images = memory.images(np.arange(31))
    described: list[tuple[int, int]] = []
    valued: list[tuple[int, int]] = []
    done = maintain(
        memory,
        Moment(1),
        MemoryConfig(capacity=30, equalise_every=1),
        predictor,  # type: ignore[arg-type]
        seed=1,
        describing=lambda *progress: described.append(progress),
        equalising=lambda *progress: valued.append(progress),
    )
    assert done.discarded.told["recomputed"]
    assert max(predictor.described) == min(part, 31)
    assert described == [(n, 31) for n in range(1, 32)]
    assert valued == [(n, len(memory)) for n in range(1, len(memory) + 1)]
    kept = images[np.isin(np.arange(1, 32), memory.ids)]
    expected = [0.7 * 0.5 + 0.3 * fake_values(image.tobytes(), 4)[0] for image in kept]
    assert memory.rows["reward"] == pytest.approx(expected, abs=1e-6)
    assert (memory.rows["descriptor"] == kept.reshape(len(kept), -1)[:, :15]).all()
