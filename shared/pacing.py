"""How long to wait: for a transfer that goes on without limit, and not all at the same time."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")
LONGEST_S = 86_400.0
"""Time for a transfer that goes on."""


def jittered(wait_s: float) -> float:
    """Some time up to this, so that those who wait for the same do not come all at once."""
    return wait_s * random.uniform(0.5, 1.0)  # noqa: S311


def paced(items: Iterable[T], patience_s: float, give_up: Callable[[], None]) -> Iterator[T]:
    """Yield items as they come. If none came for so long, a thread calls what ends `items`."""
    moved, ended = threading.Event(), False

    def watch() -> None:
        while moved.wait(patience_s) and not ended:
            moved.clear()
        if not ended:
            give_up()

    threading.Thread(target=watch, name="pacing", daemon=True).start()
    try:
        for item in items:
            moved.set()
            yield item
    finally:
        ended = True
        moved.set()
