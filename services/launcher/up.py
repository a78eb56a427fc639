"""`corridor up`: the whole system on one machine, from one command to a clean end."""

import logging
import os
import random
import socket
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

from services.launcher.keys import Keys
from services.launcher.live import RunView
from services.launcher.screen import Screen, say
from services.launcher.supervisor import ChildSpec, Ending, Supervisor
from services.launcher.watchdog import Watchdog
from services.launcher.watcher import Watcher
from services.monitor.running import locked
from services.processes import COMMAND, ROUTER, SERVICES, Process
from services.security.use import refuse_open_door
from shared import run_record, settings
from shared.config import BusConfig, Config
from shared.errors import ConfigError
from shared.numerics import settle_all
from shared.service import setup_logging
from shared.statefile import write_atomically
from shared.threads import stop_on_signals

log = logging.getLogger(__name__)

TICK_S = 0.25
STOP_KEY = " "
"""Emergency stop of all robots."""
PAGE_NEEDS = ("lmdb", "prometheus_client", "starlette", "uvicorn", "websockets")
NO_PAGE = "none: pip install 'corridor[page]'"
PORTS = range(10000, 30000)
"""Kernels give none of these to outgoing connections, so a restarted router finds its port free."""


def run_all(
    config: Config,
    folder: Path,
    *,
    listen: str | None,
    given: bool,
    insecure: bool = False,
    page: bool = True,
) -> int:
    """Run everything until Ctrl-C, SIGTERM, the wanted number of episodes or a final error.

    listen: where the own router listens; None: on loopback, on a free port. given: the endpoint was
    chosen on purpose, so the router there is used. Returns the exit code. Raises ConfigError: the
    folder belongs to another configuration or is in use, or the router must not listen there.
    """
    folder = folder.absolute()
    given = given or config.bus.endpoint != BusConfig().endpoint
    if listen is not None:
        if given:
            raise ConfigError(f"--listen: bus.endpoint {config.bus.endpoint!r} was given, too")
        refuse_open_door(listen, config.bus.credentials, insecure)
    own = None if given else listen or free_endpoint()
    endpoint = reachable(own) if own else config.bus.endpoint
    stored = settings.claim(folder, config)
    with locked(folder) as lock, stop_on_signals() as stop:
        run_record.begin(folder, stored)
        settle_all(stored, folder, tell=lambda line: say(line, 1), stopped=stop.is_set)  # alone
        if stop.is_set():
            say("corridor: stopped, the same command goes on", 1)
            return 0
        config = _found_at(endpoint, config, folder)
        setup_logging("up", folder, screen=False)  # the terminal belongs to the display
        specs = child_specs(config, stored, folder, own)
        where = add_page(specs, folder) if page else str
        environment = {k: v for k, v in os.environ.items() if not k.startswith(settings.ENV_PREFIX)}
        supervisor = Supervisor(specs, folder / "logs", environment, [lock])
        ending = supervise(config, supervisor, stop, where)
    text = ending.reason if ending.code else f"{ending.reason}; the run lies in {folder}"
    say(f"corridor: {text}", 2 if ending.code else 1)
    return ending.code


def _found_at(endpoint: str, config: Config, folder: Path) -> Config:
    """The configuration with this endpoint, which other commands find in the folder."""
    bus = config.bus.model_copy(update={"endpoint": endpoint})
    credentials = Path(bus.credentials).absolute() if bus.credentials else ""
    write_atomically(folder / "endpoint", f"{endpoint}\n{credentials}\n".encode())
    return config.model_copy(update={"bus": bus})


def supervise(
    config: Config, supervisor: Supervisor, stop: threading.Event, page: Callable[[], str] = str
) -> Ending:
    """Keep the children running until there is a reason to end; nothing here can block.

    page: tells where the web page is. Views go to the screen's thread. Keys are read, and the
    emergency stop is given, in another.
    """
    start_s, watchdog = time.monotonic(), Watchdog(config)
    with (
        Screen() as screen,
        Watcher(config) as watcher,
        Keys(lambda key: watcher.halt() if key == STOP_KEY else None) as keys,
        supervisor,
    ):
        while True:
            now_s = time.monotonic()
            ending = supervisor.poll() or _wanted(config, watcher, stop)
            view = _view(config, now_s - start_s, watcher, supervisor, keys)
            view = replace(view, page=page())
            if ending is not None:
                screen.show(replace(view, note="stopping"), last=True)
                watcher.release()
                return ending
            screen.show(view)
            if hung := watchdog.look(now_s, watcher.sight, view.children):
                supervisor.give_up(*hung)
            stop.wait(TICK_S)


def _wanted(config: Config, watcher: Watcher, stop: threading.Event) -> Ending | None:
    """An end that was asked for."""
    wanted = config.run.episodes
    if wanted and watcher.sight.snapshot.episodes_done >= wanted:
        return Ending(0, f"{wanted} episodes are done")
    return Ending(0, "all stopped") if stop.is_set() else None


def _view(
    config: Config, uptime_s: float, watcher: Watcher, supervisor: Supervisor, keys: Keys
) -> RunView:
    """What is known now."""
    return RunView(
        config.run.name,
        config.bus.endpoint,
        uptime_s,
        watcher.sight.snapshot,
        supervisor.statuses(),
        config.run.episodes,
        config.bus.heartbeat_s,
        told=watcher.told,
        keys=keys.active,
        commanded=watcher.sight.commanded,
    )


def child_specs(
    config: Config,
    stored: Config,
    folder: Path,
    own: str | None,
    services: Sequence[Process] = SERVICES,
) -> list[ChildSpec]:
    """The processes of a run: our router if `own` tells where it listens, and the services."""
    specs = []
    if own is not None:
        credentials = config.bus.credentials
        # That it may listen there has been decided before.
        secure = ("--credentials", credentials) if credentials else ("--insecure",)
        shared = f"--set=bus.shared_memory={str(config.bus.shared_memory).lower()}"
        specs.append(_spec(ROUTER, "--listen", own, shared, *secure))
    # What may differ from the stored configuration, such as the endpoint, goes along.
    changes = settings.differences(stored, config)
    options = [f"--set={key}={settings.toml_value(value)}" for key, _, value in changes]
    source = ("--config", str(folder / settings.FILE_NAME), "--run-dir", str(folder))
    return [*specs, *(_spec(process, *source, *options) for process in services)]


def add_page(specs: list[ChildSpec], folder: Path) -> Callable[[], str]:
    """Add the web page, if its libraries are there; its end ends nothing. Returns where it is."""
    if not all(map(find_spec, PAGE_NEEDS)):
        return lambda: NO_PAGE
    command = (*COMMAND, "page", "--run-dir", str(folder), "--tethered")
    specs.append(ChildSpec("page", command, stage=2, may_finish=False, vital=False))
    file = folder / "page"
    return lambda: file.read_text().strip() if file.exists() else "is starting"


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
