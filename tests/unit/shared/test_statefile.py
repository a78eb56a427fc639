"""Small saved state: whole or not at all, and taken up only once."""

from __future__ import annotations

from pathlib import Path

import msgpack
import pytest

from shared import statefile
from shared.errors import StateError

STATE = {"life": "abc", "steps": [{"image": b"\x00\xff", "x_m": 0.25}], "none": None, "n": 2**40}


def test_saved_values_come_back_once(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "down" / "state.msgpack"
    statefile.save(path, STATE)
    assert statefile.take(path) == STATE
    assert statefile.take(path) is None
    assert list(path.parent.iterdir()) == []


def test_values_that_are_kept_can_be_read_again_and_again(tmp_path: Path) -> None:
    path = tmp_path / "kept"
    assert statefile.read(path) is None
    statefile.save(path, STATE)
    assert statefile.read(path) == statefile.read(path) == STATE
    path.write_bytes(b"\xc1")
    with pytest.raises(StateError, match=r"damaged.*kept\.unreadable-1 now"):
        statefile.read(path)
    assert path.with_name("kept.unreadable-1").read_bytes() == b"\xc1"


def test_a_later_state_takes_the_place_of_an_earlier_one(tmp_path: Path) -> None:
    path = tmp_path / "state"
    statefile.save(path, {"n": 1})
    statefile.save(path, {"n": 2})
    assert [p.name for p in tmp_path.iterdir()] == ["state"]
    assert statefile.take(path) == {"n": 2}


def test_without_a_file_or_folder_there_is_nothing_to_take(tmp_path: Path) -> None:
    assert statefile.take(tmp_path / "none") is None
    assert statefile.take(tmp_path / "no" / "folder") is None


def test_a_half_written_newer_file_is_ignored_and_replaced(tmp_path: Path) -> None:
    path = tmp_path / "state"
    statefile.save(path, {"n": 1})
    path.with_name("state.new").write_bytes(b"\x81")
    assert statefile.take(path) == {"n": 1}
    assert statefile.take(path) is None
    statefile.save(path, {"n": 2})
    assert statefile.take(path) == {"n": 2}


def test_a_failed_write_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "state"
    statefile.save(path, {"n": 1})

    def full(_: int) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(statefile.os, "fsync", full)
    with pytest.raises(OSError, match="no space"):
        statefile.save(path, {"n": 2})
    monkeypatch.undo()
    assert statefile.take(path) == {"n": 1}


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        msgpack.packb(STATE)[:-1],
        msgpack.packb(STATE) + b"x",
        msgpack.packb([1, 2]),
        b"\xdf\xff\xff\xff\xff",
        b"\x81\x01\x02",
        b"\x91" * 5000,
        b"\x81\xa1\xff\x00",
    ],
    ids=lambda data: data[:4].hex() or "empty",
)
def test_a_damaged_file_is_told_as_such_and_not_met_twice(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "state"
    path.write_bytes(data)
    with pytest.raises(StateError, match="damaged saved state"):
        statefile.take(path)
    assert statefile.take(path) is None
    path.write_bytes(data)
    with pytest.raises(StateError, match=r"it lies at .*state\.unreadable-2 now"):
        statefile.take(path)
    aside = sorted(tmp_path.iterdir())
    assert [p.name for p in aside] == ["state.unreadable-1", "state.unreadable-2"]
    assert {p.read_bytes() for p in aside} == {data}


def test_what_was_taken_is_gone_on_disk_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without this a power cut brings a state back that somebody has gone on from."""
    path = tmp_path / "state"
    statefile.save(path, STATE)
    synced: list[bool] = []
    monkeypatch.setattr(statefile.os, "fsync", lambda _: synced.append(path.exists()))
    assert statefile.take(path) == STATE
    assert synced == [False]


def test_a_file_too_large_is_refused_unread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "state"
    statefile.save(path, STATE)
    monkeypatch.setattr(statefile, "LIMIT_BYTES", 10)
    with pytest.raises(StateError, match="at most 10 bytes"):
        statefile.take(path)
    assert [p.name for p in tmp_path.iterdir()] == ["state.unreadable-1"]
