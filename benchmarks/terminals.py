"""Where programs of ours read keys and show things: pseudo-terminals, and pipes that are full."""

from __future__ import annotations

import fcntl
import os
import pty
import subprocess
import sys
import termios
import tty
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

CONTROLLED = (
    "import fcntl, os, sys, termios\n"
    "fcntl.ioctl(0, termios.TIOCSCTTY, 0)\n"
    "os.execv(sys.argv[1], sys.argv[1:])\n"
)
"""Makes standard input the terminal that controls a new session, as in a window of its own."""


@contextmanager
def full_pipe() -> Iterator[int]:
    """The end to write to of a pipe that nobody reads and that takes no more."""
    read, write = os.pipe()
    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, 4096)
    os.set_blocking(write, False)
    try:
        while True:
            os.write(write, b"." * 512)
    except BlockingIOError:
        os.set_blocking(write, True)
    try:
        yield write
    finally:
        os.close(read)
        os.close(write)


class Terminal:
    """A program in a window of its own. Use as a context manager: leaving kills it."""

    def __init__(self, command: Sequence[str], **options: Any) -> None:
        """Start it; options are those of `subprocess.Popen`."""
        self._master, slave = pty.openpty()
        os.set_blocking(self._master, False)
        self._shown = b""
        streams = {"stdin": slave, "stdout": slave, "stderr": slave}
        self.process = subprocess.Popen(
            [sys.executable, "-c", CONTROLLED, *command],
            start_new_session=True,
            **{**streams, **options},
        )
        os.close(slave)

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *error: object) -> None:
        self.process.kill()
        self.process.wait(10)
        os.close(self._master)

    def press(self, keys: bytes) -> None:
        """Type."""
        os.write(self._master, keys)

    def shown(self) -> str:
        """All that was shown so far."""
        try:
            while data := os.read(self._master, 65536):
                self._shown += data
        except OSError:  # nothing more now, or the program is gone
            pass
        return self._shown.decode(errors="replace")

    def gives_lines(self) -> bool:
        """Whether the terminal gives whole lines, as a shell leaves it."""
        return bool(termios.tcgetattr(self._master)[tty.LFLAG] & termios.ICANON)
