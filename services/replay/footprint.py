"""Keeping the process small: what is asked of the C library, where it can (Linux, glibc)."""

import ctypes
import mmap
from pathlib import Path

TRIM_THRESHOLD, MMAP_THRESHOLD, ARENA_MAX = -1, -3, -8  # names of mallopt
KEPT_BYTES = 512 * 1024 * 1024
LARGEST_BYTES = 32 * 1024 * 1024
"""The most glibc lets come from the heap."""
MOST_PAGES = 1024
"""Pages of the file held at most, about: 4 MB."""


def gather_heap() -> None:
    """Let all threads allocate from one heap, large arrays too, and keep what they free.

    Otherwise passes over the memory leave up to a gigabyte of holes, or get every intermediate
    array as new, zeroed pages, in up to half of their time. Call it before other threads begin.
    """
    library = ctypes.CDLL(None)
    if hasattr(library, "mallopt"):
        library.mallopt(ARENA_MAX, 1)
        library.mallopt(MMAP_THRESHOLD, LARGEST_BYTES)
        library.mallopt(TRIM_THRESHOLD, KEPT_BYTES)


class Mapping:
    """Where LMDB maps its file, on Linux: whoever reads all would hold as much memory again."""

    def __init__(self, path: Path) -> None:
        self._ranges = _ranges_of(path.resolve())
        self._madvise = ctypes.CDLL(None).madvise if self._ranges else None
        self._looked_at = 0

    def looked_at(self, pages: int) -> None:
        """Count pages, about; let go of all when they are many. Getting them again takes time."""
        self._looked_at += pages
        if self._looked_at >= MOST_PAGES:
            self._looked_at = 0
            self.let_go()

    def let_go(self) -> None:
        """Let go of all pages of the read-only map. Harmless: readers get them again."""
        if self._madvise is not None:
            for start, size in self._ranges:
                advice = ctypes.c_int(mmap.MADV_DONTNEED)
                self._madvise(ctypes.c_void_p(start), ctypes.c_size_t(size), advice)


def _ranges_of(path: Path) -> list[tuple[int, int]]:
    """Start and size of all read-only mappings of a file into this process."""
    maps = Path("/proc/self/maps")
    found = []
    for line in maps.read_text().splitlines() if maps.exists() else ():
        addresses, rights, *_, name = line.split(maxsplit=5)
        if rights == "r--s" and name == str(path):
            start, end = (int(address, 16) for address in addresses.split("-"))
            found.append((start, end - start))
    return found
