"""`corridor up`: the whole system on one machine, from one command to a clean end."""

from __future__ import annotations

import logging
import os
import random
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Self

from rich.console import Console

from services.launcher.display import display_for
from services.launcher.live import RunView
from services.launcher.supervisor import ChildSpec, Ending, Supervisor
from services.monitor.heartbeats import Reader, Snapshot
from services.monitor.running import locked
from services.processes import COMMAND, ROUTER, SERVICES, Process
from services.security.use import refuse_open_door, using
from shared import run_record, settings
from shared.bus import Bus
from shared.config import BusConfig, Config
from shared.errors import ConfigError, RouterMissing
from shared.numerics import settle_all

log = logging.getLogger(__name__)

TICK_S = 0.25
PORTS = range(10000, 30000)
"""Kernels give none of these to outgoing connections, so a restarted router finds its port free."""


def run_all(
    config: Config, folder: Path, *, listen: str | None, given: bool, insecure: bool = False
) -> int:
    """Run everything until Ctrl-C, SIGTERM, the wanted number of episodes or a final error.

    Args:
        config: the resolved configuration.
        folder: run folder.
        listen: where the own router listens; None: on loopback, on a free port.
        given: the endpoint was chosen on purpose, so the router there is used.
        insecure: the own router may listen beyond loopback without credentials.

    Returns the exit code. Raises ConfigError: the folder belongs to another configuration or is in
    use, or the router must not listen there.
    """
    folder = folder.absolute()
    given = given or config.bus.endpoint != BusConfig().endpoint
    if listen is not None:
        if given:
            raise ConfigError(f"--listen: bus.endpoint {config.bus.endpoint!r} was given, too")
        refuse_open_door(listen, config.bus.credentials, insecure)
    stored = settings.claim(folder, config)
    run_record.begin(folder, stored)
    with locked(folder) as lock, stop_on_signals() as stop:
        settle_all(stored, folder)  # now, while nothing else runs
        own = None if given else listen or free_endpoint()
        endpoint = reachable(own) if own else config.bus.endpoint
        bus = config.bus.model_copy(update={"endpoint": endpoint})
        config = config.model_copy(update={"bus": bus})
        credentials = Path(bus.credentials).absolute() if bus.credentials else ""
        (folder / "endpoint").write_text(f"{endpoint}\n{credentials}\n")
        _log_to(folder / "logs")
        specs = child_specs(config, stored, folder, own, insecure=insecure)
        environment = {k: v for k, v in os.environ.items() if not k.startswith(settings.ENV_PREFIX)}
        supervisor = Supervisor(specs, folder / "logs", environment, [lock])
        ending = supervise(config, supervisor, stop)
    text = ending.reason if ending.code else f"{ending.reason}; the run lies in {folder}"
    console = Console(stderr=ending.code != 0, highlight=False, soft_wrap=True)
    console.print(f"corridor: {text}", markup=False)
    return ending.code


def supervise(config: Config, supervisor: Supervisor, stop: threading.Event) -> Ending:
    """Keep the children running and show how they do until there is a reason to end."""
    start_s = time.monotonic()
    with display_for(sys.stdout) as display, Watcher(config) as watcher, supervisor:
        while True:
            ending = supervisor.poll()
            snapshot = watcher.snapshot()
            wanted = config.run.episodes
            if ending is None and wanted and snapshot.episodes_done >= wanted:
                ending = Ending(0, f"{wanted} episodes are done")
            if ending is None and stop.is_set():
                ending = Ending(0, "all stopped")
            view = RunView(
                config.run.name,
                config.bus.endpoint,
                time.monotonic() - start_s,
                snapshot,
                supervisor.statuses(),
                wanted,
                config.bus.heartbeat_s,
                "stopping" if ending else "",
            )
            display.show(view)
            if ending is not None:
                watcher.release()
                return ending
            stop.wait(TICK_S)


def child_specs(
    config: Config, stored: Config, folder: Path, own: str | None, *, insecure: bool = False
) -> list[ChildSpec]:
    """The processes of a run: our router if `own` tells where it listens, and all services."""
    specs = []
    if own is not None:
        secure = ("--credentials", config.bus.credentials) if config.bus.credentials else ()
        specs.append(_spec(ROUTER, "--listen", own, *secure, *(["--insecure"] * insecure)))
    # What may differ from the stored configuration, such as the endpoint, goes along.
    changes = settings.differences(stored, config)
    options = [f"--set={key}={settings.toml_value(value)}" for key, _, value in changes]
    source = ("--config", str(folder / settings.FILE_NAME), "--run-dir", str(folder))
    return [*specs, *(_spec(process, *source, *options) for process in SERVICES)]


def _spec(process: Process, *options: str) -> ChildSpec:
    command = (*COMMAND, process.name, *options, "--tethered")
    return ChildSpec(process.name, command, process.stop_stage, process.may_finish)


def free_endpoint() -> str:
    """A loopback endpoint nobody listens at now."""
    ports = random.SystemRandom().sample(PORTS, 200)
    for port in ports:
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return f"tcp/127.0.0.1:{port}"
    raise ConfigError("router: expected a free loopback port between 10000 and 29999, found none")


def reachable(listen: str) -> str:
    """Where clients on this machine connect to a router that listens at `listen`."""
    if listen.endswith(":0"):
        raise ConfigError(f"--listen: expected a fixed port, got {listen!r}")
    return listen.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")


@contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """An event that Ctrl-C, SIGTERM and a closed terminal set; handlers are put back at the end.

    Where a closed terminal is ignored already, as under nohup, it stays ignored.
    """
    stop = threading.Event()
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _log_to(folder: Path) -> None:
    """Log to a file only: the terminal belongs to the display."""
    folder.mkdir(exist_ok=True)
    form = "%(asctime)s up %(levelname)s %(message)s"
    logging.basicConfig(filename=folder / "up.log", level=logging.INFO, format=form, force=True)


class Watcher:
    """Reads heartbeats, from the moment the router answers. Use as a context manager.

    A thread does it, because connecting may take a second, and Ctrl-C must not wait for that.
    """

    def __init__(self, config: Config) -> None:
        self._config = using(config, "operator", "watcher")
        self._done = threading.Event()
        self._snapshot = Snapshot()
        self._thread = threading.Thread(target=self._watch, name="watcher", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.release()
        self._thread.join(2.0)

    def release(self) -> None:
        """Begin to leave the bus, without waiting for it."""
        self._done.set()

    def snapshot(self) -> Snapshot:
        """The newest heartbeats; empty before the router answers."""
        return self._snapshot

    def _watch(self) -> None:
        while not self._done.is_set():
            try:
                with Bus(self._config.bus, self._config.run.name) as bus:
                    reader = Reader(bus.inbox())
                    while not self._done.wait(TICK_S):
                        reader.update()
                        self._snapshot = reader.snapshot()
            except RouterMissing:
                self._done.wait(TICK_S)
