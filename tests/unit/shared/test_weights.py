"""Weights come over the bus whole and unchanged, or not at all."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from fakes import message
from safetensors.torch import load, save

from benchmarks.waiting import wait_until
from shared import weights
from shared.config import NetworkConfig
from shared.errors import BadMessage, PeerSilent
from shared.messages import LearnerState, Weights
from shared.rl.network import initialised, to_bytes, weights_hash
from shared.service import StopFlag

DATA = bytes(range(256)) * 9


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch) -> list[Weights]:
    monkeypatch.setattr(weights, "PART_BYTES", 1000)
    return list(weights.parts(7, DATA, weights_hash(DATA)))


def fetched(answers: Sequence[Weights]) -> tuple[int, bytes]:
    bus: Any = SimpleNamespace(request_many=lambda *_, **__: iter(answers))
    return weights.fetch(bus)


def test_what_was_cut_into_parts_comes_back(parts: list[Weights]) -> None:
    assert [len(part.data) for part in parts] == [1000, 1000, 304]
    assert fetched(parts) == (7, DATA)


def test_a_part_that_is_missing_is_noticed(parts: list[Weights]) -> None:
    for answers in (parts[:-1], parts[1:], [parts[0], parts[2]]):
        with pytest.raises(PeerSilent, match="expected 3 parts"):
            fetched(answers)


def test_parts_that_do_not_match_their_hash_or_version_are_refused(parts: list[Weights]) -> None:
    middle = parts[1].data
    for odd in ({"data": middle[:-1] + b"\x00"}, {"version": 8}, {"hash": "0" * 16}):
        with pytest.raises(BadMessage, match="do not match their hash"):
            fetched([parts[0], parts[1].model_copy(update=odd), parts[2]])


def test_an_endless_answer_is_cut_off(parts: list[Weights]) -> None:
    with pytest.raises(BadMessage, match="more than 3 parts"):
        fetched([*parts, *[parts[0]] * 1000])


# ------------------------------------------------------------------------- what is asked for


def test_the_newest_announcement_counts_and_not_the_highest() -> None:
    wanted = weights.Wanted()
    wanted.note(2**31)
    assert (wanted.version, wanted.due_s(0.0)) == (2**31, 0.0)
    wanted.note(5)
    assert (wanted.version, wanted.due_s(0.0)) == (5, 0.0)


def test_what_never_comes_is_asked_for_ever_more_rarely() -> None:
    wanted, now_s, asked = weights.Wanted(), 0.0, 0
    wanted.note(2**31)
    lasting = False
    while now_s < 120.0:
        now_s += wanted.due_s(now_s)
        lasting = wanted.missed(now_s, answered=True)
        asked += 1
        wanted.note(2**31)  # said again and again
    assert lasting
    assert asked < 25
    wanted.note(6)
    assert wanted.due_s(now_s) == 0.0


def test_a_learner_that_is_away_is_asked_as_often_as_ever() -> None:
    wanted = weights.Wanted()
    for _ in range(100):
        assert not wanted.missed(0.0, answered=False)
        assert wanted.due_s(0.0) == weights.RETRY_S


# ------------------------------------------------------------------------- the fetcher

PATIENCE_S = 20.0
SMALL = NetworkConfig(filters=4)


class Learner:
    """A bus with a learner that serves what a test says, and announcements of anybody."""

    def __init__(self) -> None:
        self.serves = (1, to_bytes(initialised(SMALL, 1)))
        self.asked = 0
        self._heard: list[LearnerState] = []
        self._arrived = threading.Condition()

    def announce(self, version: int) -> None:
        with self._arrived:
            self._heard.append(message(LearnerState, weights_version=version))
            self._arrived.notify_all()

    def request_many(self, *_: Any, everybody: bool = False, **__: Any) -> Any:
        self.asked += 1
        version, data = self.serves
        return weights.parts(version, data, weights_hash(data))

    def inbox(self) -> Learner:
        return self

    def subscribe(self, *_: Any) -> None:
        pass

    def watch(self, *_: Any) -> None:
        pass

    def lives(self, *_: Any) -> frozenset[str]:
        return frozenset()

    def wake(self) -> None:
        self.announce(1)

    def wait(self, timeout_s: float) -> None:
        with self._arrived:
            self._arrived.wait_for(lambda: self._heard, timeout_s)

    def take(self, *_: Any) -> list[tuple[str, LearnerState]]:
        with self._arrived:
            heard, self._heard = self._heard, []
            return [("main", state) for state in heard]


@pytest.fixture
def learner() -> Iterator[tuple[Learner, weights.WeightsFetcher]]:
    bus, stop = Learner(), StopFlag()
    me: Any = SimpleNamespace(bus=bus, stop=stop, config=SimpleNamespace(network=SMALL))
    fetcher = weights.WeightsFetcher(me, lambda: None)
    yield bus, fetcher
    stop.set("done")
    fetcher.join(PATIENCE_S)
    assert not fetcher.is_alive()


def has(fetcher: weights.WeightsFetcher, version: int) -> None:
    wait_until(lambda: fetcher.newest[0] == version, PATIENCE_S, f"version {version}")


def test_one_forged_announcement_blocks_nothing(
    learner: tuple[Learner, weights.WeightsFetcher],
) -> None:
    bus, fetcher = learner
    has(fetcher, 1)
    bus.announce(2**32 - 1)
    wait_until(lambda: bus.asked >= 3, PATIENCE_S, "it asks for what was announced")
    bus.serves = (2, bus.serves[1])
    bus.announce(2)
    has(fetcher, 2)
    assert fetcher.refused == 0
    assert fetcher.heard[0] == 2


def test_a_version_far_above_the_announced_one_is_not_taken(
    learner: tuple[Learner, weights.WeightsFetcher],
) -> None:
    """It would keep all that are made from then on away."""
    bus, fetcher = learner
    has(fetcher, 1)
    data = bus.serves[1]
    bus.serves, before = (2**32 - 1, data), bus.asked
    bus.announce(2)
    wait_until(lambda: bus.asked >= before + 2, PATIENCE_S, "it asks again")
    assert fetcher.newest[0] == 1
    bus.serves = (3, data)
    has(fetcher, 3)  # one more than announced: the learner is about to tell


def spoilt(kind: str) -> bytes:
    network = initialised(SMALL, 2)
    if kind == "not finite":
        with torch.no_grad():
            network.out.bias[0] = math.nan
    if kind == "other layout":
        network = initialised(NetworkConfig(filters=4, layout="cpcccp"), 2)
    if kind == "other width":
        network = initialised(NetworkConfig(filters=8), 2)
    data = to_bytes(network)
    if kind == "no metadata":
        data = save(load(data))
    return data[:-1] if kind == "cut" else data


@pytest.mark.parametrize(
    "kind", ["not finite", "other layout", "other width", "no metadata", "cut"]
)
def test_weights_that_do_not_fit_are_refused_and_the_old_ones_stay(
    kind: str, learner: tuple[Learner, weights.WeightsFetcher], caplog: pytest.LogCaptureFixture
) -> None:
    bus, fetcher = learner
    has(fetcher, 1)
    good = fetcher.newest
    bus.serves = (2, spoilt(kind))
    bus.announce(2)
    wait_until(lambda: fetcher.refused >= 2, PATIENCE_S, "they are refused")
    assert fetcher.newest == good
    assert len([r for r in caplog.records if "weights refused" in r.message]) == 1
    bus.serves = (3, good[1])
    bus.announce(3)
    has(fetcher, 3)
