"""What the folder of a run tells: curves, findings, obstacles, notes, and maps of its worlds."""

import csv
import io
import json
import threading
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import numpy.typing as npt

from services.monitor.diagnose import Evidence, findings
from services.monitor.heartbeats import Snapshot
from services.robot_driver.simulated.world import WorldError, load_world
from services.robot_driver.simulated.world_parts import Obstacle
from shared import settings
from shared.facts import SHORT_NAMES
from shared.run_record import EPISODES, TRAINING, now_utc, samples_by_world

POINTS, JUDGED = 240, 1000
"""Points of a curve, and newest episodes by which a run is judged."""
NOTES, MOST_BYTES, NOTES_SHOWN = "notes.jsonl", 1 << 20, 30
"""File of the notes, its largest size, and how many of them are shown."""
Row = dict[str, str]
Floats = npt.NDArray[np.float64]


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
        if data:
            self._offset += len(data) + 1
            text = data.decode(errors="replace")
            if not self._head:
                self._head, _, text = text.partition("\n")
            self.rows += csv.DictReader(io.StringIO(f"{self._head}\n{text}"))
        return bool(data)


class Folder:
    """The folder of a run. Only `note` may be called by any thread."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._episodes, self._training = Tail(path / EPISODES), Tail(path / TRAINING)
        self._lock = threading.Lock()

    def curves(self) -> dict[str, Any] | None:
        """All curves; None if they are as they were."""
        if not self._episodes.update() | self._training.update() or not self._episodes.rows:
            return None
        rows, trained = self._episodes.rows, self._training.rows
        at = _spread(len(rows))
        few, lately = [rows[i] for i in at], [trained[i] for i in _spread(len(trained))]
        bumps, actions, fitness = (_column(rows, n) for n in ("bump", "actions", "fitness"))
        worlds = [samples_by_world(row.get("by_world") or "") for row in few]
        told: dict[str, dict[str, Sequence[float] | Floats]] = {
            "fitness": {"mean": moving(fitness, np.ones(len(rows)), 100)[at]},
            "bumps": {"bumps": 1000 * moving(bumps, actions, 1000)[at]},
            "laps": {name: _column(few, f"laps_{name}") for name in ("left", "right")},
            "threshold": {"percent": _column(few, "threshold_percent")},
            "actions": {name: _column(few, name) for name in SHORT_NAMES},
            "worlds": {world: [counts.get(world, 0) for counts in worlds] for world in worlds[-1]},
            "discarded": {n: _column(few, n) for n in ("discarded", "last_resort")},
        }
        shown = {name: _curve(few, series) for name, series in told.items()}
        return {**shown, "loss": _curve(lately, {"loss": _column(lately, "loss")})}

    def findings(self, seen: Snapshot | None) -> list[str]:
        """Why the run does not learn. seen: its heartbeats, once all had the time to come."""
        trained = {row["episode"]: row for row in self._training.rows[-JUDGED:]}
        rows = [row | trained.get(row["episode"], {}) for row in self._episodes.rows[-JUDGED:]]
        found = findings(Evidence(settings.read_folder(self.path), rows, live=seen))
        return [f"{f.illness}: {f.measured}; usual: {f.usual}. {f.remedy}" for f in found]

    def obstacles(self, robot: str, world: str) -> list[dict[str, Any]]:
        """The obstacles around a robot: those its driver wrote down, else those of the world."""
        try:
            kept = msgpack.unpackb((self.path / "robot" / robot / "world.msgpack").read_bytes())
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


def _spread(count: int) -> list[int]:
    """At most `POINTS` places of so many, first and last among them."""
    places = np.linspace(0, max(count - 1, 0), min(count, POINTS)).astype(int)
    return [int(place) for place in np.unique(places)]


def _column(rows: list[Row], name: str) -> Floats:
    return np.array([float(row.get(name) or "nan") for row in rows])


def moving(values: Floats, weights: Floats, window: float) -> Floats:
    """Sum of values over that of weights, in as many rows up to each as weigh `window`."""
    total, weight = (np.concatenate([[0.0], np.cumsum(v)]) for v in (values, weights))
    first = np.searchsorted(weight, weight[1:] - window)
    return np.asarray((total[1:] - total[first]) / np.maximum(weight[1:] - weight[first], 1.0))


def _curve(rows: list[Row], series: dict[str, Sequence[float] | Floats]) -> dict[str, Any]:
    """Episodes and values, ready for JSON."""

    def shown(values: Sequence[float] | Floats) -> list[float | None]:
        return [None if np.isnan(value) else float(f"{value:.4g}") for value in values]

    y = {name: shown(values) for name, values in series.items()}
    return {"x": [int(row["episode"]) for row in rows], "y": y}


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
