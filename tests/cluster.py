"""The real system in real processes: router and four services, killed and restarted at will."""

from __future__ import annotations

import itertools
import os
import signal
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

from forked import Forked

from benchmarks.waiting import wait_until
from services import processes
from services.security.use import using
from shared import settings
from shared.bus import Bus
from shared.config import Config
from shared.inbox import Inbox
from shared.keys import LEARNER_STATE, REPLAY_STATE
from shared.messages import LearnerState, Message, ReplayState

SERVICES = tuple(process.name for process in processes.SERVICES)
ALL = tuple(process.name for process in processes.PROCESSES)


WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
_ports = itertools.count(30_000 + 600 * WORKER)
"""Other ports for each worker. Neither `corridor up` nor the system gives these to anybody."""


def free_port() -> int:
    """A port nobody uses now; the router of a cluster must keep its port over restarts."""
    for port in _ports:
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise AssertionError("unreachable")


def make_config(run_name: str, **sections: dict[str, object]) -> Config:
    """A configuration with a narrow network, quick periods and an endpoint of its own."""
    tree: dict[str, dict[str, object]] = {
        "run": {"name": run_name, "seed": 7},
        "bus": {
            "endpoint": f"tcp/127.0.0.1:{free_port()}",
            "heartbeat_s": 0.2,
            "request_timeout_s": 2.0,
        },
        "robot": {"resend_s": 0.2},
        "episode": {"max_samples": 60, "horizon": 20},
        "network": {"filters": 8},
        "memory": {"capacity": 400, "equalise_every": 10},
        "learning": {"batch_size": 32, "fit_every": 15, "mini_batches_per_episode": 2},
    }
    for section, values in sections.items():
        tree.setdefault(section, {}).update(values)
    return Config.model_validate(tree)


class Cluster:
    """Processes of one run in one folder. Use as a context manager: leaving kills what is left."""

    def __init__(self, config: Config, folder: Path) -> None:
        self.config, self.folder = config, folder
        self._file = folder.parent / f"{folder.name}.toml"
        settings.write(config, self._file)
        self._processes: dict[str, Forked] = {}
        self._bus: Bus | None = None
        self._inbox: Inbox | None = None
        self._newest: dict[type[Message], Message] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._bus is not None:
            self._bus.close()
        for name in list(self._processes):
            self._forget(name)

    def start(self, *names: str) -> None:
        """Start router or services as a user would, each in a process of its own."""
        for name in names:
            if name == "router":
                self._launch(name, name, "--listen", self.config.bus.endpoint)
            else:
                self._launch(name, name, "--run-dir", str(self.folder))

    def start_second_driver(self, robot: str) -> None:
        """Start another simulated robot of the same run."""
        place = ("--run-dir", str(self.folder), "--set", f"robot.id={robot}")
        self._launch(f"driver-{robot}", "driver", *place)

    def run_to_its_end(self, service: str, name: str) -> int | None:
        """Start a service as `start` does, under another name, and wait for its exit code."""
        self._launch(name, service, "--run-dir", str(self.folder))
        return self.ended(name)

    def ended(self, name: str) -> int | None:
        """The exit code of a process that ends by itself."""
        return self._processes[name].wait(20)

    def _launch(self, name: str, service: str, *options: str) -> None:
        self._forget(name)
        self.folder.mkdir(parents=True, exist_ok=True)
        words = [service, *options, "--config", str(self._file), "--tethered"]
        self._processes[name] = Forked(words, self.folder / f"{name}.out")

    def _forget(self, name: str) -> None:
        process = self._processes.pop(name, None)
        if process is not None:
            process.kill()
            process.wait(10)
            process.close()

    def kill(self, *names: str) -> None:
        """kill -9."""
        for name in names:
            self._processes[name].kill()
            self._processes[name].wait(10)

    def freeze(self, name: str) -> None:
        """SIGSTOP: alive, but not answering."""
        self._processes[name].send_signal(signal.SIGSTOP)

    def thaw(self, name: str) -> None:
        """SIGCONT."""
        self._processes[name].send_signal(signal.SIGCONT)

    def stop(self, *names: str) -> None:
        """SIGTERM in this order, each to its clean end with exit code 0."""
        for name in names:
            process = self._processes[name]
            process.send_signal(signal.SIGTERM)
            assert process.wait(20) == 0, (
                f"{name} ended with {process.returncode}: {self.log(name)}"
            )

    def stop_all(self) -> None:
        """Stop everything the way `corridor up` does."""
        self.stop("driver", "actor", "replay", "learner", "router")

    def log(self, name: str) -> str:
        """The end of what a process printed."""
        path = self.folder / f"{name}.out"
        return path.read_text()[-3000:] if path.exists() else ""

    @property
    def bus(self) -> Bus:
        """A client of the cluster's router, connected on first use, as an operator."""
        if self._bus is None:
            self._bus = wait_until(self._connect, 20, "router answers")
            self._inbox = self._bus.inbox()
            self._inbox.subscribe(LEARNER_STATE, "main")
            self._inbox.subscribe(REPLAY_STATE, "main")
        return self._bus

    def learner(self) -> LearnerState | None:
        """The newest heartbeat of the learner."""
        self._poll()
        found = self._newest.get(LearnerState)
        return found if isinstance(found, LearnerState) else None

    def replay(self) -> ReplayState | None:
        """The newest heartbeat of replay."""
        self._poll()
        found = self._newest.get(ReplayState)
        return found if isinstance(found, ReplayState) else None

    def stall(self, duration_s: float) -> None:
        """Let a drawn time pass, so that what follows hits the others anywhere in their work."""
        threading.Event().wait(duration_s)

    def wait_episodes(self, count: int, timeout_s: float) -> None:
        """Wait until the learner is done with this many episodes."""

        def done() -> bool:
            state = self.learner()
            return state is not None and state.episode >= count

        self.wait(done, timeout_s, f"{count} episodes learnt")

    def wait(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Wait, and show every process's last words when the deadline passes."""
        try:
            wait_until(condition, timeout_s, what)
        except AssertionError as error:
            tails = "\n".join(f"--- {name}\n{self.log(name)}" for name in self._processes)
            raise AssertionError(f"{error}\n{self.learner()}\n{self.replay()}\n{tails}") from None

    def _connect(self) -> Bus | None:
        from shared.errors import RouterMissing

        try:
            return Bus(using(self.config, "operator").bus, self.config.run.name)
        except RouterMissing:
            return None

    def _poll(self) -> None:
        assert self.bus
        assert self._inbox is not None
        for stream, cls in ((LEARNER_STATE, LearnerState), (REPLAY_STATE, ReplayState)):
            for _, state in self._inbox.take(stream, cls):
                self._newest[cls] = state
