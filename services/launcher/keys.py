"""Keys pressed while `corridor up` runs, from the terminal it was started in.

Only a foreground process may read a terminal: another one is stopped by SIGTTIN, or by SIGTTOU when
it changes how the terminal works. So the thread here looks where it is each time, blocks both
signals for itself, and takes the terminal again after Ctrl-Z and `fg`.
"""

import os
import select
import signal
import termios
import threading
import tty
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Self

POLL_S = 0.1
READ_BYTES = 256
STOPPING = {signal.SIGTTIN, signal.SIGTTOU}


class Keys:
    """Calls `on_key` for each key, in a thread of its own. Use as a context manager.

    Without a terminal it does nothing. Leaving gives the terminal back as it was.
    """

    def __init__(self, on_key: Callable[[str], None], descriptor: int = 0) -> None:
        self._on_key, self._descriptor = on_key, descriptor
        self.active = False
        """Whether keys are read now."""
        self._before: list[Any] | None = None
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run, name="keys", daemon=True)

    def __enter__(self) -> Self:
        if os.isatty(self._descriptor):
            self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._done.set()
        if self._thread.is_alive():
            self._thread.join(2 * POLL_S)  # not for `on_key`, which may wait for an answer
        if self._before is None:
            return
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)
        with suppress(OSError, termios.error):  # the terminal may be gone
            if self._in_front():
                termios.tcsetattr(self._descriptor, termios.TCSANOW, self._before)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)

    def _run(self) -> None:
        try:
            self._read_all()
        finally:
            self.active = False

    def _read_all(self) -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)
        while not self._done.is_set():
            self.active = self._take()
            data = self._read() if self.active else b""
            if data is None:  # nothing pressed
                continue
            for key in dict.fromkeys(data.decode("latin-1")):  # one held down is pressed once
                self._on_key(key)
            if not data:
                self._done.wait(POLL_S)

    def _take(self) -> bool:
        """Have the terminal give every key at once, unshown, if it is ours; Ctrl-C still stops."""
        try:
            if not self._in_front():
                return False
            attributes = termios.tcgetattr(self._descriptor)
            if attributes[tty.LFLAG] & termios.ICANON:
                self._before = attributes
                tty.setcbreak(self._descriptor, termios.TCSANOW)
        except (OSError, termios.error):
            return False
        return True

    def _read(self) -> bytes | None:
        """Keys; None without any; empty when the terminal is gone or not ours any more."""
        ready, _, _ = select.select([self._descriptor], [], [], POLL_S)
        if not ready:
            return None
        try:
            return os.read(self._descriptor, READ_BYTES)
        except OSError:
            return b""

    def _in_front(self) -> bool:
        """Whether the terminal controls this process, and this process is in the foreground."""
        return os.tcgetpgrp(self._descriptor) == os.getpgrp()
