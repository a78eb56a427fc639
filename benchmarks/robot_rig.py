"""A driver in front of an emulated robot, in real processes, with faults at will.

Shared by `benchmarks/robot_reaction.py` and the tests of the fault table.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx

from benchmarks.waiting import wait_until
from shared import settings
from shared.bus import Bus
from shared.config import Config
from shared.errors import PeerMissing, RouterMissing
from shared.halts.orders import RobotOrder, order
from shared.keys import ROBOT_STATE
from shared.messages import RobotState
from shared.provenance import ROOT

LEFT = "1"
PATIENCE_S = 90.0
PARTS = ("forward_m_s", "left_m_s", "turn_rad_s")


class Rig:
    """Router, emulated Robotino, driver and a stand-in for the actor. Use as a context manager.

    Args:
        config: For the driver; its robot's address is filled in.
        folder: Run folder.
    """

    def __init__(self, config: Config, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self._processes: dict[str, subprocess.Popen[str]] = {}
        address = self._first_line("emulator", "emulate", "robotino", "--listen", "127.0.0.1:0")
        self.http = httpx.Client(base_url=f"http://{address}", timeout=30.0, trust_env=False)
        tree = config.to_dict()
        tree["robot"]["robotino"]["address"] = address
        self.config = Config.model_validate(tree)
        self._file = folder / "given.toml"
        settings.write(self.config, self._file)
        self._bus: Bus | None = None
        self.state: RobotState | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.http.close()
        if self._bus is not None:
            self._bus.close()
        for name in list(self._processes):
            self._forget(name)

    # ------------------------------------------------------------ processes

    def start(self, *names: str) -> None:
        """Start `router`, `driver` or `actor`."""
        for name in names:
            if name == "router":
                self._first_line(name, name, "--listen", self.config.bus.endpoint)
            elif name == "actor":
                arguments = (self.config.bus.endpoint, self.config.run.name, LEFT)
                script = "benchmarks.standin_actor"
                self._spawn(name, [sys.executable, "-m", script, *arguments])
            else:
                options = ("--config", str(self._file), "--run-dir", str(self.folder))
                self._corridor(name, name, *options)

    def kill(self, name: str) -> float:
        """SIGKILL; returns when."""
        now_s = time.monotonic()
        self._processes[name].kill()
        self._processes[name].wait(10)
        return now_s

    def signal(self, name: str, number: int) -> float:
        """Send a signal; returns when."""
        now_s = time.monotonic()
        self._processes[name].send_signal(number)
        return now_s

    def stop(self, name: str) -> None:
        """SIGTERM, to a clean end."""
        process = self._processes[name]
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0, self.log(name)

    def log(self, name: str) -> str:
        """The end of what a process printed on standard error."""
        path = self.folder / f"{name}.err"
        return path.read_text()[-3000:] if path.exists() else ""

    def _corridor(self, name: str, *arguments: str) -> subprocess.Popen[str]:
        return self._spawn(name, [sys.executable, "-m", "services.cli", *arguments, "--tethered"])

    def _first_line(self, name: str, *arguments: str) -> str:
        process = self._corridor(name, *arguments)
        assert process.stdout is not None
        line = process.stdout.readline().strip()
        assert line, f"{name} did not start: {self.log(name)}"
        return line

    def _spawn(self, name: str, command: Sequence[str]) -> subprocess.Popen[str]:
        self._forget(name)
        environment = {k: v for k, v in os.environ.items() if not k.startswith("CORRIDOR_")}
        with (self.folder / f"{name}.err").open("ab") as errors:
            process = self._processes[name] = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env=environment,
                cwd=ROOT,
                start_new_session=True,
            )
        return process

    def _forget(self, name: str) -> None:
        process = self._processes.pop(name, None)
        if process is not None:
            process.kill()
            process.wait(10)
            for stream in (process.stdin, process.stdout):
                assert stream is not None
                stream.close()

    # ------------------------------------------------------------ the emulated robot

    def faults(self, **changes: object) -> float:
        """Change faults of the emulated robot; returns when they began to hold, at the latest."""
        reply = self.http.post("/emulator/faults", content=json.dumps(changes))
        assert reply.status_code == 200, reply.text
        return time.monotonic()

    def truth(self) -> dict[str, Any]:
        """What the robot really does."""
        tree: dict[str, Any] = self.http.get("/emulator/truth").json()
        return tree

    def wait_driving(self) -> None:
        """Wait until the robot moves, and moves on."""

        def moves() -> bool:
            before = self.truth()
            time.sleep(0.3)
            after = self.truth()
            return before["still_since_s"] is None and after["still_since_s"] is None

        self.wait(moves, "the robot drives")

    def wait_still(self, since_s: float) -> float:
        """Wait until the robot stands; returns how long that took since `since_s`."""

        def stands() -> bool:
            still_s = self.truth()["still_since_s"]
            return still_s is not None and self.truth()["still_since_s"] == still_s

        self.wait(stands, "the robot stands")
        return max(float(self.truth()["still_since_s"]) - since_s, 0.0)

    def first_stop_s(self, since_s: float) -> float:
        """When the first stop arrived at the robot after `since_s`, as time since then."""

        def stops() -> list[float]:
            return [
                command["at_s"] - since_s
                for command in self.truth()["commands"]
                if command["at_s"] >= since_s and not any(command[part] for part in PARTS)
            ]

        return float(self.wait(stops, "a stop arrives")[0])

    # ------------------------------------------------------------ the driver

    @property
    def bus(self) -> Bus:
        """A client of the router."""
        if self._bus is None:
            self._bus = wait_until(self._connect, PATIENCE_S, "the router answers")
            assert self._bus is not None
            self._inbox = self._bus.inbox()
            self._inbox.subscribe(ROBOT_STATE)
        return self._bus

    def wait_state(self, condition: Callable[[RobotState], bool], what: str) -> RobotState:
        """Wait for a heartbeat of the driver that meets a condition."""

        def met() -> RobotState | None:
            assert self.bus
            for _, state in self._inbox.take(ROBOT_STATE, RobotState):
                self.state = state
                if condition(state):
                    return state
            return None

        found = self.wait(met, what)
        assert isinstance(found, RobotState)
        return found

    def command(self, name: RobotOrder) -> RobotState:
        """An operator's order, repeated until it is obeyed; the next heartbeat."""

        def obeyed() -> bool:
            try:
                return order(self.bus, name, self.config.robot.id, lambda _: None)
            except PeerMissing:
                return False

        assert self.bus
        self._inbox.take(ROBOT_STATE, RobotState)
        wait_until(obeyed, PATIENCE_S, f"{name} obeyed")
        return self.wait_state(lambda _: True, "a heartbeat")

    def wait(self, condition: Callable[[], Any], what: str) -> Any:
        """Wait with a deadline, and show what was known when it passes."""
        try:
            return wait_until(condition, PATIENCE_S, what)
        except AssertionError as error:
            logs = "\n".join(f"--- {name}\n{self.log(name)}" for name in self._processes)
            raise AssertionError(f"{error}\n{self.state}\n{self.truth()}\n{logs}") from None

    def _connect(self) -> Bus | None:
        try:
            return Bus(self.config.bus, self.config.run.name)
        except RouterMissing:
            return None
