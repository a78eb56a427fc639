"""The keys of a terminal as a person's wishes, and the emergency stop among them."""

import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Generic

from services.commander.keyboard import KeyParser, W, Wish
from shared.bus import Bus
from shared.errors import ConfigError, PeerMissing
from shared.halts.orders import order

READ_BYTES = 256
ESTOP_S = 3.0
"""The driver is told of an emergency stop again and again for so long."""


def require_terminal(command: str) -> None:
    """Raise ConfigError if standard input is no terminal."""
    if not sys.stdin.isatty():
        raise ConfigError(f"{command}: expected a terminal as standard input, for its keys")


@contextmanager
def single_keys(descriptor: int) -> Iterator[int]:
    """Have a terminal give every key at once, unshown, while the block runs; Ctrl-C still stops."""
    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor, termios.TCSANOW)
        yield descriptor
    finally:
        with suppress(termios.error):  # it may be gone
            termios.tcsetattr(descriptor, termios.TCSANOW, before)


class Keys(Generic[W]):
    """What the person at a terminal wants of one robot."""

    def __init__(
        self, descriptor: int, meaning: Mapping[str, W], nothing: W, stop: Callable[[], None]
    ) -> None:
        """stop: Called when an emergency stop is asked for."""
        self._descriptor, self._stop = descriptor, stop
        self._keys, self._wish = KeyParser(), Wish(meaning, nothing)
        self.quits = False
        """Whether the person asked for the end."""

    def read(self, timeout_s: float = 0.0) -> bool:
        """Take the keys pressed since, or the first that comes in time.

        Returns False when the person quits or the terminal is gone.
        """
        ready, _, _ = select.select([self._descriptor], [], [], timeout_s)
        if ready:
            try:
                data = os.read(self._descriptor, READ_BYTES)
            except OSError:
                return False
            if not data:
                return False
            now_s = time.monotonic()
            for key in self._keys.feed(data):
                self._wish.press(key, now_s)
        command = self._wish.take_command()
        if command == "estop":
            self._stop()
        self.quits = command == "quit"
        return not self.quits

    def wanted(self) -> W:
        """What is wanted now."""
        return self._wish.now(time.monotonic())


def emergency_stop(bus: Bus, robot: str, echo: Callable[[str], None]) -> None:
    """Tell the driver to stop and stay stopped; meanwhile it hears nothing, and stops, too."""
    stands, until_s = False, time.monotonic() + ESTOP_S
    with suppress(PeerMissing):
        stands = order(bus, "estop", robot, echo, ended=lambda: time.monotonic() > until_s)
    what = "corridor clear releases it" if stands else "no answer, press e again"
    echo(f"{robot}: emergency stop: {what}")
