"""The recorder: hears everything a run publishes, fetches every version of the weights, writes."""

import time
from collections.abc import Callable
from pathlib import Path

from services.recorder.recording import RECORDED, Origin, RecordingWriter
from services.recorder.tap import Tap
from shared.config import Config, Numerics
from shared.errors import ConfigError, StateError
from shared.numerics import known
from shared.service import EXIT_CRASH, TICK_S, Service, Stopped, service
from shared.weights import WeightsFetcher

FLUSH_S = 1.0
"""Period of writing to disk: a killed recorder loses no more than this."""
TELL_S = 10.0
MIB = 1024 * 1024


def run(
    config: Config, folder: Path, path: Path, limit_mib: int, echo: Callable[[str], None]
) -> int:
    """Record until stopped, or until the file is as large as it may be.

    Args:
        config: Of the run.
        folder: Of the run: the numerics that were chosen for its actor are there.
        path: File to write.
        limit_mib: Largest file.
        echo: Shows a line.

    Returns:
        The exit code.

    Raises:
        ConfigError: The numerics of the actor are not known, the file cannot be made, or the run
            has another configuration.
        StateError: The file cannot be written any more.
    """
    origin = Origin(config, actor_numerics(config, folder))
    try:
        with service("recorder", "main", config) as me, RecordingWriter(path, origin) as writer:
            echo(f"recording run {config.run.name!r} to {path}; Ctrl-C ends it")
            Recorder(me, writer, limit_mib * MIB, echo).run()
    except OSError as error:
        raise StateError(f"--out: {path}: cannot be written: {error.strerror}") from error
    except Stopped:
        echo(f"nothing recorded: stopped while there was no router at {config.bus.endpoint}")
        return EXIT_CRASH
    return 0


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
        self, me: Service, writer: RecordingWriter, limit: int, echo: Callable[[str], None]
    ) -> None:
        self._me, self._writer, self._limit, self._echo = me, writer, limit, echo
        self._tap = Tap(me.bus, RECORDED)
        self._fetcher = WeightsFetcher(me, self._tap.wake)
        me.stop.on_set(self._tap.wake)
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
                self._echo(f"the file has {self._limit // MIB} MiB: the recording ends here")
                break
        self._take(0.0)
        self._writer.add_summary(self.counts())
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
            self._writer.add_weights(version, data, time.time_ns())
            self._version, self._versions = version, self._versions + 1
