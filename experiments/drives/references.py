"""Floor and ceiling of frozen drives: chance, and the planner that knows the map.

They depend on world, robot and starts alone, so they are driven once and kept beside the runs.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

from experiments.drives.choosers import Chooser, Planned, uniform
from experiments.drives.frozen_drives import evaluate
from experiments.drives.traces import Figures
from experiments.environment import CorridorEnv
from shared.statefile import write_atomically

_CHOOSERS: dict[str, Callable[[CorridorEnv], Chooser]] = {
    "random": lambda _: uniform,
    "planner": lambda env: Planned(env.robot.world, env.config.robot),
}
DRIVERS = tuple(_CHOOSERS)


def reference(env: CorridorEnv, driver: str, starts: int, actions: int, kept: Path) -> Figures:
    """Figures of a driver that learns nothing, from the folder `kept` where they are known.

    Raises:
        KeyError: No such driver.
    """
    path = kept / f"{driver}-{env.robot.world.name}-{_key(env, starts, actions)}.json"
    if path.is_file():
        return {str(key): float(value) for key, value in json.loads(path.read_text()).items()}
    figures = evaluate(env, _CHOOSERS[driver](env), starts, actions).figures
    write_atomically(path, json.dumps(figures).encode())
    return figures


def _key(env: CorridorEnv, starts: int, actions: int) -> str:
    """8 hex digits over everything that decides the figures."""
    decides = {
        "robot": env.config.robot.model_dump(mode="json"),
        "horizon": env.config.episode.horizon,
        "world": env.robot.world.fingerprint,
        "drives": [starts, actions],
    }
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:8]
