"""The replay process keeps no more memory than it needs (Linux, glibc)."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from builders import make_episode

from services.replay import footprint
from services.replay.footprint import Mapping
from services.replay.storage import Storage
from shared.config import MemoryConfig

SMAPS = Path("/proc/self/smaps")
HEAP = """
import resource, threading, numpy as np
from services.replay import footprint
from services.replay.footprint import gather_heap
gather_heap()
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
def work():
    np.ones(16_000_000, np.uint8)
    before = faults()
    for _ in range(20):
        np.ones(16_000_000, np.uint8)
    print(faults() - before)
thread = threading.Thread(target=work)
thread.start()
thread.join()
"""


def held_kb(path: Path) -> int:
    """Pages of a mapped file that this process holds."""
    parts = SMAPS.read_text().split(f"{path}\n")[1:]
    return sum(int(found[1]) for part in parts if (found := re.search(r"Rss: +(\d+)", part)))


def stored_and_read(folder: Path) -> tuple[Storage, int]:
    """A storage whose 300 samples (1.2 MB) have all been read; the part of the file held now."""
    storage = Storage(folder, MemoryConfig(capacity=300), "run1/1")
    storage.commit(make_episode(300, fill=True))
    pending = storage.pending(0)
    assert pending is not None
    assert len(pending.rows) == len(pending.images) == 300
    return storage, held_kb((folder / "data.mdb").resolve())


def test_pages_of_the_file_are_let_go_of_when_many_have_been_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(footprint, "MOST_PAGES", 300)
    storage, held = stored_and_read(tmp_path)
    assert held < 600
    storage.close()


def test_before_that_they_are_held(tmp_path: Path) -> None:
    storage, held = stored_and_read(tmp_path)
    assert held > 1200
    storage.close()


def test_an_unknown_file_has_no_pages_to_let_go_of(tmp_path: Path) -> None:
    Mapping(tmp_path / "nothing").let_go()


def test_freed_arrays_of_other_threads_are_used_again() -> None:
    """Fresh pages for 20 arrays of 16 MB would be 78,000 faults."""
    done = subprocess.run([sys.executable, "-c", HEAP], check=True, capture_output=True, text=True)
    assert int(done.stdout) < 5000
