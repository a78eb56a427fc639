"""The recorder: hears everything a run publishes, fetches every version of the weights, writes.

It writes as it hears, or keeps the last seconds in memory and writes those each time it gets the
signal SIGUSR1, and at its end.
"""

import math
import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from services.recorder.recording import RECORDED, Origin, RecordingWriter
from services.recorder.ring import Ring
from services.recorder.tap import Tap, Version
from services.recorder.views import Solids
from shared.config import Config, Numerics
from shared.errors import ConfigError, StateError
from shared.numerics import known
from shared.service import EXIT_CRASH, TICK_S, Service, Stopped, service
from shared.weights import WeightsFetcher

FLUSH_S = 1.0
"""Period of writing to disk: a killed recorder loses no more than this."""
TELL_S = 10.0
MIB = 1024 * 1024


@dataclass(frozen=True)
class Order:
    """Where to record, the largest file, and what stands in worlds.

    last_s: If above 0, so many seconds are kept, and written when told to.
    """

    path: Path
    limit_mib: int
    last_s: float = 0.0
    solids: Solids = lambda _: ()


def run(config: Config, folder: Path, order: Order, echo: Callable[[str], None]) -> int:
    """Record a run until stopped, or until the file is as large as it may be.

    folder: of the run: the numerics that were chosen for its actor are there; echo: shows a line.
    Returns the exit code.

    Raises:
        ConfigError: The numerics of the actor are not known, the file cannot be made, or the run
            has another configuration.
        StateError: The file cannot be written any more.
    """
    origin = Origin(config, actor_numerics(config, folder))
    record = _keep if order.last_s else _write
    try:
        with service("recorder", "main", config) as me:
            record(me, order, origin, echo)
    except OSError as error:
        raise StateError(f"--out: {order.path}: cannot be written: {error.strerror}") from error
    except Stopped:
        echo(f"nothing recorded: stopped while there was no router at {config.bus.endpoint}")
        return EXIT_CRASH
    return 0


def _write(me: Service, order: Order, origin: Origin, echo: Callable[[str], None]) -> None:
    """Write all that is heard."""
    with RecordingWriter(order.path, origin, order.solids) as writer:
        echo(f"recording run {me.config.run.name!r} to {order.path}; Ctrl-C ends it")
        recorder = Recorder(me, writer, echo, order.limit_mib * MIB)
        recorder.run()
        writer.add_summary(recorder.counts())


def _keep(me: Service, order: Order, origin: Origin, echo: Callable[[str], None]) -> None:
    """Keep what is heard; write it to the next file at every signal and at the end."""
    path, ring, wanted = order.path, Ring(order.last_s), threading.Event()

    def on_signal(*_: object) -> None:
        wanted.set()
        recorder.wake()

    def write() -> None:
        wanted.clear()
        files = (path.with_name(f"{path.stem}-{number}{path.suffix}") for number in count(1))
        file = next(file for file in files if not file.exists())
        with RecordingWriter(file, origin, order.solids) as writer:
            ring.write(writer)
            writer.add_summary(recorder.counts())
        echo(f"{file}: {writer.messages} messages")

    recorder = Recorder(me, ring, echo, each=lambda: write() if wanted.is_set() else None)
    signal.signal(signal.SIGUSR1, on_signal)
    echo(f"keeping the last seconds; kill -USR1 {os.getpid()} writes them, Ctrl-C ends it")
    recorder.run()
    write()


def actor_numerics(config: Config, folder: Path) -> Numerics:
    """How the run's actor computes. Raises ConfigError when that was chosen elsewhere."""
    if (found := known(config, folder, "actor")) is None:
        raise ConfigError(
            f"numerics.actor: chosen when the run first starts, expected in {folder}, which has "
            f"none: record beside the run, with --run-dir"
        )
    return found


class Recorder:
    """One thread: takes what was heard, writes it, and says how much that was."""

    def __init__(
        self,
        me: Service,
        writer: RecordingWriter | Ring,
        echo: Callable[[str], None],
        limit: float = math.inf,
        each: Callable[[], None] = lambda: None,
    ) -> None:
        """limit: most bytes of a file; each: called again and again."""
        self._me, self._writer, self._echo, self._limit = me, writer, echo, limit
        self._each = each
        self._tap = Tap(me.bus, RECORDED)
        self.wake = self._tap.wake
        self._fetcher = WeightsFetcher(me, self.wake)
        me.stop.on_set(self.wake)
        self._version = self._versions = self._skipped = 0
        self._started_s = time.monotonic()

    def run(self) -> None:
        """Record until stopped."""
        flush_s, tell_s = 0.0, time.monotonic() + TELL_S
        while not self._me.stop.is_set():
            self._take(TICK_S)
            now_s = time.monotonic()
            if now_s >= flush_s:
                flush_s = now_s + FLUSH_S
                self._writer.flush()
            if now_s >= tell_s:
                tell_s = now_s + TELL_S
                self._echo(str(self))
            if self._writer.size >= self._limit:
                self._echo(f"the file has {self._limit / MIB:.0f} MiB: the recording ends here")
                break
            self._each()
        self._take(0.0)
        self._echo(str(self))

    def counts(self) -> dict[str, int]:
        """How much was recorded, and how much was not."""
        lost = {f"lost.{name}": count for name, count in sorted(self._tap.lost.items())}
        return {
            "messages": self._writer.messages,
            "weights": self._versions,
            "weights.skipped": self._skipped,
            "refused": self._writer.refused,
            **lost,
        }

    def __str__(self) -> str:
        lost = self._tap.lost.total() + self._writer.refused
        return (
            f"{time.monotonic() - self._started_s:.0f} s, {self._writer.messages} messages "
            f"({lost} lost), {self._versions} versions of the weights "
            f"({self._skipped} skipped), "
            f"{self._writer.size / MIB:.1f} MiB"
        )

    def _take(self, timeout_s: float) -> None:
        for heard in self._tap.take(timeout_s):
            self._writer.add(heard)
        version, data = self._fetcher.newest
        if version > self._version:
            self._skipped += version - self._version - 1 if self._version else 0
            self._writer.add(Version(version, time.time_ns(), data))
            self._version, self._versions = version, self._versions + 1
