"""A robot without a run: router and driver for as long as somebody commands the robot."""

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from services.launcher.supervisor import Supervisor
from services.launcher.up import child_specs, free_endpoint
from services.monitor.running import locked
from services.processes import DRIVER
from shared import settings
from shared.bus import Bus
from shared.config import Config
from shared.errors import ConfigError, PeerMissing, RouterMissing
from shared.threads import stop_on_signals

TICK_S = 0.1
START_S = 90.0
"""Longest that router and driver may take until the robot is there."""


@contextmanager
def alone(config: Config, folder: Path) -> Iterator[Config]:
    """Run a router and the driver of one robot; yields how to reach it, once it is there.

    The folder keeps logs and halts: a robot that was stopped stays so the next time. Nothing is
    learnt in it, so it may be used with other configurations later.

    Raises ConfigError: refused by the driver, or a run's folder; PeerMissing: not there in time.
    """
    folder = folder.absolute()
    if (folder / "memory").exists() or (folder / "learner").exists():
        raise ConfigError(f"folder {folder}: a run lies there, choose another one with --run-dir")
    (folder / "logs").mkdir(parents=True, exist_ok=True)
    own = free_endpoint()
    bus = config.bus.model_copy(update={"endpoint": own, "credentials": ""})
    config = config.model_copy(update={"bus": bus})
    environment = {k: v for k, v in os.environ.items() if not k.startswith(settings.ENV_PREFIX)}
    with locked(folder) as lock:
        (folder / settings.FILE_NAME).unlink(missing_ok=True)
        stored = settings.claim(folder, config)
        (folder / "endpoint").write_text(f"{own}\n\n")
        specs = child_specs(config, stored, folder, own, [DRIVER])
        with Supervisor(specs, folder / "logs", environment, [lock]) as supervisor:
            _wait_for_robot(config, supervisor)
            done = threading.Event()
            thread = threading.Thread(target=_poll, args=(supervisor, done), daemon=True)
            thread.start()
            try:
                yield config
            finally:
                done.set()
                thread.join()


def _wait_for_robot(config: Config, supervisor: Supervisor) -> None:
    deadline_s = time.monotonic() + START_S
    with stop_on_signals() as stop:
        while time.monotonic() < deadline_s and not stop.wait(TICK_S):
            if ending := supervisor.poll():
                raise ConfigError(ending.reason)
            try:
                with Bus(config.bus, config.run.name) as bus:
                    if bus.peers(DRIVER.name, config.robot.id):
                        return
            except RouterMissing:
                continue
    raise PeerMissing(f"robot {config.robot.id!r}: its driver did not start in time")


def _poll(supervisor: Supervisor, done: threading.Event) -> None:
    """Restart what crashes; whoever commands the robot sees that it is silent meanwhile."""
    while not done.wait(TICK_S) and supervisor.poll() is None:
        pass
