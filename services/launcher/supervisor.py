"""Child processes: start them, restart what crashes or hangs, end them all in order.

A child that exits with 0 was asked to stop and stays stopped. Exit codes 2, 3 and 4 (wrong
configuration, bad state, role taken) would come again: they end everything, with the child's own
line. Any other end is a crash and is answered by a restart, later each time it happens again.

Children run in sessions of their own, so that Ctrl-C reaches only us, and are tethered
(`services.launcher.tether`): when this process is killed, they end by themselves.
"""

import logging
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Literal, Self

from shared.threads import jittered

log = logging.getLogger(__name__)

STAGE_ENDS_S = (0.8, 1.6, 3.4, 3.9)
"""When each stage of a stop is over at the latest. After the last one, what is left is killed."""
KILLED_S = 1.0
"""A killed process is gone by then, or waits for a disk, and cannot be killed."""
FIRST_DELAY_S, LONGEST_DELAY_S = 0.25, 10.0
STEADY_S = 30.0
"""A child that ran this long is restarted at once when it crashes."""
FINAL_CODES = (2, 3, 4)
MOST_OUTPUT_BYTES = 8 * 1024 * 1024
TAIL_BYTES = 16 * 1024
"""As much of the output of an ended child is looked at."""


@dataclass(frozen=True)
class ChildSpec:
    """One process to keep running."""

    name: str
    command: tuple[str, ...]
    stage: int
    """Place in the order of stopping, from 0 to `len(STAGE_ENDS_S) - 1`."""
    may_finish: bool = True
    """Whether exit code 0 means that it is done; otherwise it is restarted."""
    vital: bool = True
    """Whether an end that would come again ends everything."""


@dataclass(frozen=True)
class ChildStatus:
    """How one child is doing."""

    name: str
    state: Literal["running", "restarting", "stopped"]
    restarts: int
    note: str
    """How the newest crash ended; empty without one."""
    up_s: float = 0.0
    """How long the process has run."""


@dataclass(frozen=True)
class Ending:
    """Why everything is to end, and the exit code of the whole."""

    code: int
    reason: str


class Supervisor:
    """Keeps children running. Use as a context manager: leaving ends them all."""

    def __init__(
        self,
        specs: Sequence[ChildSpec],
        logs: Path,
        environment: Mapping[str, str],
        pass_descriptors: Sequence[int] = (),
    ) -> None:
        """Prepare; nothing is started yet.

        logs: existing folder for the output of each child, `<name>.out`. pass_descriptors: files
        that stay open in the children.
        """
        self._children = [_Child(spec, logs / f"{spec.name}.out") for spec in specs]
        self._environment, self._descriptors = dict(environment), tuple(pass_descriptors)

    def __enter__(self) -> Self:
        try:
            for child in self._children:
                child.start(self._environment, self._descriptors)
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    def poll(self) -> Ending | None:
        """Look at all children once and restart crashed ones; returns why to end, if so."""
        for child in self._children:
            child.trim()
            code = child.ended()
            if code in FINAL_CODES and child.spec.vital:
                return Ending(code, f"{child.spec.name}: {child.last_line() or f'exit {code}'}")
            if code is not None:
                child.settle(code)
            elif child.is_due():
                child.start(self._environment, self._descriptors)
        finishing = [child for child in self._children if child.spec.may_finish]
        if finishing and all(child.finished for child in finishing):
            return Ending(0, "all services have stopped")
        return None

    def give_up(self, name: str, reason: str) -> None:
        """Kill a child that hangs; its end is then answered by a restart, like a crash."""
        next(child for child in self._children if child.spec.name == name).give_up(reason)

    def statuses(self) -> tuple[ChildStatus, ...]:
        """How each child is doing, in the order of the specs."""
        return tuple(child.status() for child in self._children)

    def pids(self) -> dict[str, int]:
        """Process ids of the children running now."""
        return {c.spec.name: c.process.pid for c in self._children if c.process is not None}

    def stop(self) -> None:
        """End all children in stages within five seconds: SIGTERM, then SIGKILL."""
        start_s = time.monotonic()
        for stage, end_s in enumerate(STAGE_ENDS_S):
            for child in self._children:
                if child.spec.stage == stage:
                    child.terminate()
            self._wait(stage, start_s + end_s)
        for child in self._children:
            child.kill()

    def _wait(self, stage: int, deadline_s: float) -> None:
        """Wait until all children up to this stage are gone, or the deadline."""
        waiting = [child for child in self._children if child.spec.stage <= stage]
        while any(child.is_alive() for child in waiting) and time.monotonic() < deadline_s:
            time.sleep(0.02)


class _Child:
    """One spec with its current process."""

    def __init__(self, spec: ChildSpec, output: Path) -> None:
        self.spec, self._output = spec, output
        self.process: subprocess.Popen[bytes] | None = None
        self.finished = False
        self._starts, self._offset = 0, 0
        self._started_s, self._due_s = 0.0, 0.0
        self._delay_s = FIRST_DELAY_S
        self._note, self._given_up = "", ""

    def start(self, environment: Mapping[str, str], descriptors: tuple[int, ...]) -> None:
        with self._output.open("ab") as stream:
            self._offset = stream.tell()
            self.process = subprocess.Popen(
                self.spec.command, stdin=subprocess.PIPE, stdout=stream, stderr=stream,
                env=environment, pass_fds=descriptors, start_new_session=True,
            )  # fmt: skip
        self._starts += 1
        self._started_s = time.monotonic()
        log.info("%s started as process %d", self.spec.name, self.process.pid)

    def ended(self) -> int | None:
        """The exit code, once, when the process has just ended."""
        if self.process is None:
            return None
        code = self.process.poll()
        if code is not None:
            self._forget()
        return code

    def settle(self, code: int) -> None:
        """Decide what follows after an exit code that does not end everything."""
        if code == 0 and self.spec.may_finish:
            self.finished = True
            log.info("%s has stopped", self.spec.name)
            return
        if time.monotonic() - self._started_s > STEADY_S:
            self._delay_s = FIRST_DELAY_S
        how = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        self._note = self._given_up or f"{how}: {self.last_line()}".removesuffix(": ")
        self._given_up = ""
        delay_s = jittered(self._delay_s)
        self._due_s = time.monotonic() + delay_s
        log.warning("%s crashed (%s), restart in %.1f s", self.spec.name, self._note, delay_s)
        self._delay_s = min(2 * self._delay_s, LONGEST_DELAY_S)

    def trim(self) -> None:
        """Begin the output anew once it is large. The part before is kept, where there is room."""
        if self._output.exists() and self._output.stat().st_size > MOST_OUTPUT_BYTES:
            with suppress(OSError):
                shutil.copyfile(self._output, self._output.with_suffix(".out.1"))
            os.truncate(self._output, 0)
            self._offset = 0

    def is_due(self) -> bool:
        return self.process is None and not self.finished and time.monotonic() >= self._due_s

    def is_alive(self) -> bool:
        return self.process is not None and self.process.poll() is None

    def status(self) -> ChildStatus:
        state: Literal["running", "restarting", "stopped"] = (
            "stopped" if self.finished else "restarting" if self.process is None else "running"
        )
        up_s = time.monotonic() - self._started_s if state == "running" else 0.0
        return ChildStatus(self.spec.name, state, max(0, self._starts - 1), self._note, up_s)

    def last_line(self) -> str:
        """What the process last said about its end, since it was started."""
        with self._output.open("rb") as stream:
            stream.seek(0, os.SEEK_END)
            stream.seek(max(self._offset, stream.tell() - TAIL_BYTES))
            return verdict(stream.read().decode(errors="replace"))

    def terminate(self) -> None:
        if self.process is not None and self.is_alive():
            self.process.terminate()

    def kill(self) -> None:
        if self.process is None:
            return
        if self.is_alive():
            log.warning("%s does not stop: killed", self.spec.name)
            os.killpg(self.process.pid, signal.SIGKILL)
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(KILLED_S)
        self._forget()

    def give_up(self, reason: str) -> None:
        """Kill the process now, for this reason."""
        if self.process is not None and self.is_alive():
            self._given_up = reason
            log.warning("%s: %s: killed, restarted", self.spec.name, reason)
            os.killpg(self.process.pid, signal.SIGKILL)

    def _forget(self) -> None:
        """Close our end of the tether of an ended process."""
        stdin: IO[bytes] | None = self.process.stdin if self.process else None
        if stdin is not None:
            stdin.close()
        self.process = None


def verdict(output: str) -> str:
    """The one line of a process's output that says best why it ended.

    The exception of a traceback, whose text may go on for more lines, else the last line; without
    the time and name that the logger puts in front.
    """
    lines = output.strip().splitlines() or [""]
    traceback = max(
        (i for i, text in enumerate(lines) if text.startswith("Traceback ")), default=None
    )
    raised = lines if traceback is None else lines[traceback + 1 :]
    exceptions = [text for text in raised if re.match(r"[A-Za-z_][\w.]*(:|$)", text)]
    chosen = exceptions[0] if traceback is not None and exceptions else lines[-1]
    return re.sub(r"^(\S+ \S+ \S+ (ERROR|WARNING|INFO) |corridor: )", "", chosen.strip())
