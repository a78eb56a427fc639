"""A driver in front of an emulated ROS 2 robot, in real processes, with faults at will.

Shared by `benchmarks/ros2_reaction.py` and the tests of the fault table.
"""

from __future__ import annotations

import json
import subprocess
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from benchmarks.robot_rig import PATIENCE_S, Rig
from services.robot_driver.emulation.ros2_faults import FAULTS_KEY, TRUTH_KEY
from shared import settings
from shared.bus import Bus
from shared.config import Config
from shared.foreign_bus import ForeignBus
from shared.messages import RobotState


class Ros2Rig(Rig):
    """Router, emulated ROS 2 robot, driver and a stand-in for the actor. A context manager.

    Args:
        config: For the driver; its robot's endpoint is filled in. The emulator has the same topics
            and types.
        folder: Run folder.
    """

    def __init__(self, config: Config, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self._processes: dict[str, subprocess.Popen[str]] = {}
        self._file = folder / "given.toml"
        settings.write(config, self._file)
        place = ("--listen", "tcp/127.0.0.1:0", "--config", str(self._file))
        endpoint = self._first_line("emulator", "emulate", "ros2", *place)
        tree = config.to_dict()
        tree["robot"]["ros2"]["endpoint"] = endpoint
        self.config = Config.model_validate(tree)
        settings.write(self.config, self._file)
        self._bus: Bus | None = None
        self.state: RobotState | None = None
        self._robot = ForeignBus(endpoint)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._robot.close()
        if self._bus is not None:
            self._bus.close()
        for name in list(self._processes):
            self._forget(name)

    def faults(self, **changes: object) -> float:
        """Change faults of the emulated robot; returns when they began to hold, at the latest."""
        self._ask(FAULTS_KEY, changes)
        return time.monotonic()

    def truth(self) -> dict[str, Any]:
        """What the robot really does."""
        return self._ask(TRUTH_KEY, {})

    def _ask(self, key: str, changes: dict[str, object]) -> dict[str, Any]:
        """Ask the emulator, again while its session is closed."""
        limit_s = time.monotonic() + PATIENCE_S
        while True:
            answer = self._robot.ask(key, json.dumps(changes).encode(), timeout_s=10.0)
            if answer is not None:
                return dict(json.loads(answer))
            assert time.monotonic() < limit_s, f"the emulator does not answer: {key}"
            time.sleep(0.02)
