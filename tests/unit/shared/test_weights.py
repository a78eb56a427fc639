"""Weights come over the bus whole and unchanged, or not at all."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from shared import weights
from shared.errors import BadMessage, PeerSilent
from shared.messages import Weights
from shared.rl.network import weights_hash

DATA = bytes(range(256)) * 9


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch) -> list[Weights]:
    monkeypatch.setattr(weights, "PART_BYTES", 1000)
    return list(weights.parts(7, DATA, weights_hash(DATA)))


def fetched(answers: Sequence[Weights]) -> tuple[int, bytes]:
    bus: Any = SimpleNamespace(request_many=lambda *_: iter(answers))
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
