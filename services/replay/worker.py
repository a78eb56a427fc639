"""The thread that owns the replay memory: one turn after the other, away from the serving threads.

It applies each turn in one transaction. Killed at any moment, it does the turn again.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from services.replay.storage import Storage, Submission
from services.replay.tables import Position
from shared.facts import ACTION_COUNT
from shared.metrics import MetricsLog
from shared.numerics import settle
from shared.rl.memory import ReplayMemory
from shared.rl.predictor import Predictor
from shared.rl.retention.strategy import strategy
from shared.rl.schedule import Moment
from shared.rl.turn import Commit, maintain
from shared.run_record import EPISODES, REPLAY_COLUMNS, STAGE, turn_columns
from shared.service import TICK_S, Service, Stopped
from shared.weights import WeightsFetcher

Activity = Literal["idle", "committing", "descriptors", "equalising", "discarding", "waiting"]


@dataclass(frozen=True)
class View:
    """What others may see of the memory: replaced as a whole, never changed."""

    position: Position
    by_action: tuple[int, ...] = (0,) * ACTION_COUNT
    retention: Mapping[str, int] = field(default_factory=dict)
    """What the strategy of retention tells of itself."""
    weights_version: int = 0
    activity: Activity = "idle"
    progress: float = 1.0
    fitness: tuple[int, ...] = field(default=())
    """Fitness of the last 100 counted episodes."""

    @property
    def fitness_mean(self) -> float:
        """Mean fitness of the last 100 episodes (A37)."""
        return float(np.mean(self.fitness)) if self.fitness else 0.0


class TurnWorker(threading.Thread):
    """Processes commits in order. `notify` is called whenever the view changes."""

    def __init__(
        self, me: Service, storage: Storage, folder: Path, notify: Callable[[], None]
    ) -> None:
        super().__init__(name="turns", daemon=True)
        self._me, self._storage, self._notify = me, storage, notify
        self._config = me.config.memory
        self._wake = threading.Event()
        self._predictor = Predictor(me.config.network, settle(me.config, folder, "replay"))
        self.weights = WeightsFetcher(me, lambda: None)
        self._metrics = MetricsLog(folder / EPISODES, REPLAY_COLUMNS)
        self._began_s = 0.0
        self._recent: deque[int] = deque(maxlen=100)
        self.view = View(storage.position())
        me.stop.on_set(self._wake.set)

    def submitted(self) -> None:
        """There is a new commit (any thread)."""
        self._wake.set()

    def run(self) -> None:
        """Work until the service stops."""
        try:
            memory = self._storage.load()
            memory.check_valid()
            self._restart_metrics()
            self._show(memory, activity="idle")
            while not self._me.stop.is_set():
                pending = self._storage.pending(self.view.position.processed)
                if pending is None:
                    self._wake.wait(TICK_S)
                    self._wake.clear()
                    continue
                self._turn(memory, pending)
        finally:
            self._metrics.close()

    def _turn(self, memory: ReplayMemory, submission: Submission) -> None:
        """Do everything that replay does about one submission (E25)."""
        commit, record = submission.commit, submission.record
        if commit.episode:
            self._show(memory, activity="waiting")
            version, data = self.weights.wait_for(int(record["weights_version"]))
            if version > self._predictor.version:
                self._predictor.load(version, data)
        self._show(memory, activity="discarding")
        memory.worlds = submission.worlds
        memory.append(submission.rows, submission.images)
        done = maintain(
            memory,
            Moment(commit.episode, record["totals"]["actions"], record["actions"]),
            self._config,
            self._predictor,
            self._me.config.run.seed,
            describing=self._progress("descriptors"),
            equalising=self._progress("equalising"),
        )
        if commit.episode:  # written first: a row without its turn is dropped at the next start
            self._recent.append(int(record["fitness"]))
            worlds = submission.rows["world"]
            world = memory.worlds[int(worlds[-1])] if len(worlds) else ""
            row = {
                **_basic_row(commit, record),
                "world": world,
                **turn_columns(memory, done),
                "seconds": round(time.monotonic() - self._began_s, 2),
            }
            self._me.insist("write down an episode", lambda: self._metrics.write(row))
        position = self._me.insist(
            "keep a turn", lambda: self._storage.apply_turn(submission, memory, done)
        )
        if done.discarded.warning:
            self._me.log.warning("episode %d: %s", commit.episode, done.discarded.warning)
        self._show(memory, position=position, activity="idle")

    def _progress(self, activity: Activity) -> Callable[[int, int], None]:
        def report(done: int, of: int) -> None:
            self.view = replace(self.view, activity=activity, progress=done / max(of, 1))
            if self._me.stop.is_set():
                raise Stopped("a pass over the memory")

        return report

    def _show(
        self, memory: ReplayMemory, *, activity: Activity, position: Position | None = None
    ) -> None:
        self.view = View(
            position or self.view.position,
            tuple(memory.by_action()),
            strategy(self._config.strategy).state(memory),
            self._predictor.version,
            activity,
            fitness=tuple(self._recent),
        )
        self._notify()

    def _restart_metrics(self) -> None:
        """Make the CSV agree with what is on disk: rows of unprocessed episodes come again."""
        processed = self.view.position.processed
        found = self._metrics.rows()
        self._began_s = time.monotonic() - (float(found[-1]["seconds"]) if found else 0.0)
        written = {int(row["episode"]): row for row in found}
        rows: list[dict[str, int | float | str]] = []
        for record in self._storage.records():
            commit = Commit(**record["commit"])
            if commit.commit > processed:
                break
            if not commit.episode:
                continue
            self._recent.append(int(record["fitness"]))
            rows.append({**written.get(commit.episode, {}), **_basic_row(commit, record)})
        self._metrics.restart(rows)


def _basic_row(commit: Commit, record: dict[str, Any]) -> dict[str, int | float | str]:
    """What the files of the memory tell of an episode, for its row of the table."""
    totals = record["totals"]
    counted = ("bumps", "laps_left", "laps_right", "longest_run_actions")
    return {
        "episode": commit.episode,
        "stage": STAGE,
        **{name: record[name] for name in ("robot", "ended", "fitness", "actions")},
        "bump": int(record["bump"]),
        "total_actions": totals["actions"],
        **{name: totals[name] for name in counted},
        "samples": commit.stored,
        "acting_version": record["weights_version"],
    }
