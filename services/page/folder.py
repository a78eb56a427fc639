"""What the folder of a run tells: curves, obstacles, notes, and the maps of its worlds."""

from __future__ import annotations

import csv
import io
import json
import threading
from functools import cache
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import numpy.typing as npt

from services.robot_driver.simulated.world import WorldError, load_world
from services.robot_driver.simulated.world_parts import Obstacle
from shared.facts import SHORT_NAMES
from shared.run_record import EPISODES, TRAINING, now_utc, samples_by_world

POINTS = 240
"""Points of a curve: as many as a narrow picture shows."""
NOTES, MOST_BYTES, NOTES_SHOWN = "notes.jsonl", 1 << 20, 30
"""File of the notes, its largest size, and how many of them are shown."""
Row = dict[str, str]


class Tail:
    """The rows of a table that grows; one that was written anew is read again."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file, self._offset, self._head = 0, 0, ""
        self.rows: list[Row] = []

    def update(self) -> bool:
        """Read what is new; whether there was anything."""
        if not self._path.exists():
            return False
        with self._path.open("rb") as stream:
            found = self._path.stat()
            if found.st_ino != self._file or found.st_size < self._offset:
                self._file, self._offset, self._head, self.rows = found.st_ino, 0, "", []
            stream.seek(self._offset)
            data = stream.read().rpartition(b"\n")[0]
        if not data:
            return False
        self._offset += len(data) + 1
        text = data.decode(errors="replace")
        if not self._head:
            self._head, _, text = text.partition("\n")
        self.rows += csv.DictReader(io.StringIO(f"{self._head}\n{text}"))
        return True


class Folder:
    """The folder of a run. Only `note` may be called by any thread."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._episodes, self._training = Tail(path / EPISODES), Tail(path / TRAINING)
        self._lock = threading.Lock()

    def curves(self) -> dict[str, Any] | None:
        """All curves; None if they are as they were."""
        if not self._episodes.update() | self._training.update():
            return None
        rows, trained = self._episodes.rows, self._training.rows
        bumps, actions, fitness = (_column(rows, n) for n in ("bump", "actions", "fitness"))
        worlds = samples_by_world(rows[-1].get("by_world") or "") if rows else {}
        return {
            "fitness": thinned(rows, mean=moving(fitness, np.ones(len(rows)), 100)),
            "bumps": thinned(rows, bumps=1000 * moving(bumps, actions, 1000)),
            "laps": thinned(rows, left="laps_left", right="laps_right"),
            "loss": thinned(trained, loss="loss"),
            "threshold": thinned(rows, percent="threshold_percent"),
            "actions": thinned(rows, **{name: name for name in SHORT_NAMES}),
            "worlds": thinned(rows, **{name: _of_world(rows, name) for name in worlds}),
            "discarded": thinned(rows, discarded="discarded", by_age="last_resort"),
        }

    def obstacles(self, robot: str, world: str) -> list[dict[str, Any]]:
        """The obstacles around a robot: those its driver wrote down, else those of the world."""
        try:
            path = self.path / "robot" / robot / "world.msgpack"
            kept = msgpack.unpackb(path.read_bytes())
            if kept["world"] == world:
                return [_drawn(Obstacle.model_validate(tree)) for tree in kept["obstacles"]]
        except (OSError, ValueError, KeyError, TypeError):
            pass  # there is none yet, or it does not fit: the driver tells what is wrong
        return list((map_of(world) or {}).get("obstacles", ()))

    def note(self, text: str, episode: int) -> str:
        """Keep a note of a person; what became of it."""
        line = json.dumps({"time": now_utc(), "episode": episode, "text": text}) + "\n"
        with self._lock, (self.path / NOTES).open("a") as stream:
            if stream.tell() + len(line) > MOST_BYTES:
                return f"NOT kept: {NOTES} is full"
            stream.write(line)
        return f"kept at episode {episode}"

    def notes(self) -> list[dict[str, Any]]:
        """The newest notes, oldest first."""
        path = self.path / NOTES
        lines = path.read_text().splitlines()[-NOTES_SHOWN:] if path.exists() else []
        return [json.loads(line) for line in lines]


def _column(rows: list[Row], name: str) -> npt.NDArray[np.float64]:
    return np.array([float(row.get(name) or "nan") for row in rows])


def _of_world(rows: list[Row], world: str) -> npt.NDArray[np.float64]:
    counts = (samples_by_world(row.get("by_world") or "").get(world, 0) for row in rows)
    return np.array([float(count) for count in counts])


def moving(
    values: npt.NDArray[np.float64], weights: npt.NDArray[np.float64], window: float
) -> npt.NDArray[np.float64]:
    """Sum of values over that of weights, in as many rows up to each as weigh `window`."""
    total, weight = (np.concatenate([[0.0], np.cumsum(v)]) for v in (values, weights))
    first = np.searchsorted(weight, weight[1:] - window)
    return np.asarray((total[1:] - total[first]) / np.maximum(weight[1:] - weight[first], 1.0))


def thinned(rows: list[Row], **series: str | npt.NDArray[np.float64]) -> dict[str, Any]:
    """Some rows, the newest among them: their episodes, and the values of each series."""
    chosen = np.unique(np.linspace(0, max(len(rows) - 1, 0), min(len(rows), POINTS)).astype(int))

    def shown(values: str | npt.NDArray[np.float64]) -> list[float | None]:
        found = (_column(rows, values) if isinstance(values, str) else values)[chosen]
        return [None if np.isnan(value) else float(f"{value:.4g}") for value in found]

    x = [int(rows[i]["episode"]) for i in chosen]
    return {"x": x, "y": {name: shown(values) for name, values in series.items()}}


@cache
def map_of(world: str) -> dict[str, Any] | None:
    """Walls, bounds and obstacles of a world in metres; None: this machine does not know it."""
    try:
        found = load_world(world)
    except WorldError:
        return None
    drawn = [_drawn(obstacle) for obstacle in found.obstacles]
    walls = [wall.points for wall in found.walls]
    return {"bounds": found.bounds, "walls": walls, "obstacles": drawn}


def _drawn(obstacle: Obstacle) -> dict[str, Any]:
    return {"name": obstacle.name, "corners": obstacle.corners.round(3).tolist()}
