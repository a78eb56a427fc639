"""Output to a terminal or pipe that may block for ever, without anybody else waiting for it.

Nothing here goes through `sys.stdout`: Python flushes that at its end, and would wait again.
"""

import logging
import os
import threading
from typing import Self

from services.launcher.display import display_for
from services.launcher.live import RunView

log = logging.getLogger(__name__)

WAKE_S = 1.0
LAST_S = 0.2
"""Time that is left for the view when all has ended, and for the closing line: a stop must stay
within five seconds."""


class Screen:
    """One place for the newest view, and the thread that shows it. Use as a context manager."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._view: RunView | None = None
        self._done = False
        self._thread = threading.Thread(target=self._run, name="display", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        with self._changed:
            self._done = True
            self._changed.notify()
        self._thread.join(LAST_S)

    def show(self, view: RunView, *, last: bool = False) -> None:
        """Replace what waits to be shown; after the last one the thread ends. Never blocks."""
        with self._changed:
            self._view, self._done = view, last
            self._changed.notify()

    def _run(self) -> None:
        try:
            with (
                os.fdopen(os.dup(1), "w", errors="replace") as output,
                display_for(output) as display,
            ):
                while (view := self._next()) is not None:
                    display.show(view)
        except Exception as error:  # nobody reads any more: the run goes on
            log.warning("the live view ends: %s", error, exc_info=not isinstance(error, OSError))

    def _next(self) -> RunView | None:
        """The newest view not yet shown; None at the end."""
        with self._changed:
            while self._view is None and not self._done:
                self._changed.wait(WAKE_S)
            view, self._view = self._view, None
            return view


def say(line: str, descriptor: int) -> None:
    """Write a line, unless the output takes none within `LAST_S`."""

    def write() -> None:
        try:
            os.write(descriptor, f"{line}\n".encode(errors="replace"))
        except OSError as error:
            log.warning("nobody reads %r: %s", line, error)

    thread = threading.Thread(target=write, name="last-line", daemon=True)
    thread.start()
    thread.join(LAST_S)
