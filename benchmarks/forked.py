"""Processes of ours that start quickly: forked from one that has imported everything before.

They run the same command line as `corridor`, have their own process group, environment and output,
and can be killed, frozen and stopped like any other. Importing PyTorch takes seconds of processor
time, and the tests start hundreds of processes.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Sequence
from multiprocessing.connection import Connection
from pathlib import Path

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(
    [
        "services.cli.main",
        "services.actor.service",
        "services.learner.service",
        "services.replay.service",
        "services.robot_driver.service",
        "services.router.service",
    ]
)


class Forked:
    """A running `corridor` command.

    Args:
        arguments: Its command line.
        output: File to which it appends what it prints.
    """

    def __init__(self, arguments: Sequence[str], output: Path) -> None:
        stdin, self._held = CONTEXT.Pipe(duplex=False)
        self._process = CONTEXT.Process(target=_main, args=(tuple(arguments), stdin, output))
        self._process.start()
        stdin.close()

    @property
    def returncode(self) -> int | None:
        """Exit code, or minus the signal that ended it; None while it runs."""
        return self._process.exitcode

    def send_signal(self, number: signal.Signals) -> None:
        """Send it a signal."""
        assert self._process.pid is not None
        os.kill(self._process.pid, number)

    def kill(self) -> None:
        """SIGKILL, as by `kill -9`; nothing happens if it has ended."""
        self._process.kill()

    def wait(self, timeout_s: float) -> int:
        """Its exit code. Raises TimeoutError when it does not end in time."""
        self._process.join(timeout_s)
        if self._process.exitcode is None:
            raise TimeoutError(f"process {self._process.pid} still runs")
        return self._process.exitcode

    def close(self) -> None:
        """Let go of its standard input: a tethered process ends then."""
        self._held.close()


def _main(arguments: tuple[str, ...], stdin: Connection, output: Path) -> None:
    """Become what a shell would have started, then run the command line."""
    os.setsid()
    os.dup2(stdin.fileno(), 0)
    with output.open("ab") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    for name in [name for name in os.environ if name.startswith("CORRIDOR_")]:
        del os.environ[name]
    from services.cli.main import main

    sys.exit(main(arguments))
