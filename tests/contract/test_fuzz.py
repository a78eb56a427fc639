"""Every reader of foreign bytes takes damaged payloads or refuses them."""

from __future__ import annotations

import pytest
from fuzz import CORPUS, attempt, fuzz, targets

COUNT, SEED = 6000, 7


def test_damaged_payloads_are_taken_or_refused() -> None:
    told: list[str] = []
    assert fuzz(COUNT, SEED, tell=told.append) == 0, told
    assert told[-1].startswith(f"{COUNT} payloads for {len(targets())} readers")


def test_an_unexpected_error_and_a_hang_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    target = targets()["ros2 bool"]
    assert attempt(target, b"") == ""
    monkeypatch.setattr("fuzz.HANG_S", -1.0)
    assert attempt(target, target.good[0]).startswith("took")
    broken = type(target)(lambda data: data[99], (b"x",), (), target.mutate)
    assert attempt(broken, b"x") == "IndexError: index out of range"


def test_what_found_something_once_finds_nothing_now() -> None:
    known = {name.replace(" ", "-"): target for name, target in targets().items()}
    for path in CORPUS.glob("*"):
        assert attempt(known[path.name.rsplit("-", 2)[0]], path.read_bytes()) == "", path.name
