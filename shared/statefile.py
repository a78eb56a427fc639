"""Small state on disk: saved by a clean stop and taken up once, or kept for every next start."""

import errno
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import msgpack

from shared.errors import DiskFull, StateError

LIMIT_BYTES = 64 * 1024 * 1024


@contextmanager
def needing_room(path: Path) -> Iterator[None]:
    """Raise DiskFull where an error tells that there was no room for this file."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise DiskFull(f"disk full: {path}") from error


def write_atomically(path: Path, data: bytes, mode: int = 0o666) -> None:
    """Write a file so that after a kill or power cut it is either the old or the new one."""
    beside = path.with_name(path.name + ".new")
    with needing_room(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.unlink(missing_ok=True)
        try:
            handle = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
            with os.fdopen(handle, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            beside.replace(path)
        finally:
            beside.unlink(missing_ok=True)
        sync(path.parent)


def create(path: Path, data: bytes) -> None:
    """Write a file whole unless there is one already: of several processes the first wins."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, beside = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with needing_room(path), os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fchmod(file.fileno(), 0o644)
            os.fsync(file.fileno())
        os.link(beside, path)
    except FileExistsError:
        pass
    finally:
        os.unlink(beside)


def save(path: Path, state: dict[str, Any]) -> None:
    """Save plain values."""
    write_atomically(path, msgpack.packb(state))


def take(path: Path) -> dict[str, Any] | None:
    """Read saved values and remove the file for good: whoever is killed must not come back to them.

    Returns None when there is none. Raises StateError when it is damaged; it is set aside then.
    """
    state = read(path)
    if state is not None:
        path.unlink()
        sync(path.parent)
    return state


def read(path: Path) -> dict[str, Any] | None:
    """Read saved values and leave them there; None when there is no file. Raises like `take`."""
    try:
        if path.stat().st_size > LIMIT_BYTES:
            raise ValueError(f"expected at most {LIMIT_BYTES} bytes")
        state = msgpack.unpackb(path.read_bytes())
        if not isinstance(state, dict):
            raise ValueError("not a map")
        return state
    except FileNotFoundError:
        return None
    except (ValueError, msgpack.UnpackException) as error:
        aside = set_aside(path)
        raise StateError(f"{path}: damaged saved state: {error}; it lies at {aside} now") from error


def set_aside(path: Path) -> Path:
    """Give a file that cannot be read another name beside it, so that nothing is ever lost."""
    aside = next(
        name
        for n in count(1)
        if not (name := path.with_name(f"{path.name}.unreadable-{n}")).exists()
    )
    path.rename(aside)
    sync(path.parent)
    return aside


def sync(folder: Path) -> None:
    """Bring what was renamed or removed in a folder to disk."""
    directory = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)
