"""Where the live view goes: a table in a terminal, a line every few seconds anywhere else."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from rich.console import Console
from rich.live import Live

from services.launcher.live import RunView, line, panel, warnings

LINE_EVERY_S = 1.5
"""Period of the plain lines; a change of the warnings shows at once."""
LEAST_COLUMNS, LEAST_ROWS = 70, 20
"""In a smaller window the table would lose its end, which tells what is wrong."""


class Table:
    """A table that is redrawn in place."""

    def __init__(self, live: Live) -> None:
        self._live = live

    def show(self, view: RunView) -> None:
        """Redraw the table, as the window is now."""
        width, height = self._live.console.size
        small = width < LEAST_COLUMNS or height < LEAST_ROWS
        self._live.update(panel(view, small=small), refresh=True)


class Lines:
    """One line now and then."""

    def __init__(self, output: TextIO, clock: Callable[[], float] = time.monotonic) -> None:
        self._output, self._clock = output, clock
        self._next_s = 0.0
        self._shown: tuple[int, str, str] = (0, "", "")

    def show(self, view: RunView) -> None:
        """Write a line if it is time, or if something else is wrong than before."""
        state = (len(warnings(view)), view.told, view.note)
        if self._clock() < self._next_s and state == self._shown:
            return
        self._next_s, self._shown = self._clock() + LINE_EVERY_S, state
        self._output.write(line(view) + "\n")
        self._output.flush()


@contextmanager
def display_for(output: TextIO) -> Iterator[Lines | Table]:
    """The display that suits an output."""
    console = Console(file=output, markup=False, emoji=False)
    if not console.is_terminal:
        yield Lines(output)
        return
    # What else is printed must not wait for this terminal, which may block.
    with Live(
        console=console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False
    ) as live:
        yield Table(live)
