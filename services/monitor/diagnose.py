"""Why a run does not learn: what usually is wrong, from its tables, its memory and its heartbeats.

Pure: from numbers to findings in words, whose texts stand in `illnesses.toml`. Where there is too
little to judge by, nothing is found.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from services.monitor.heartbeats import Snapshot
from services.monitor.words import by_action
from shared.facts import SHORT_NAMES
from shared.run_record import samples_by_world

if TYPE_CHECKING:
    from shared.config import Config
    from shared.rl.memory import ReplayMemory

RECENT, LEAST = 100, 30
"""Newest episodes that are looked at; fewer than the latter tell little."""
PICTURES, DRIVEN = 400, 2000
"""Newest samples of which pictures, and of which actions and places, are looked at."""
Told = Iterator[tuple[bool, str, str]]
"""Whether an illness is there, its name, and what was measured."""


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, in words."""

    illness: str
    measured: str
    usual: str
    remedy: str


@dataclass(frozen=True)
class Evidence:
    """What is known of a run.

    live: heartbeats of one that is up, once every service had the time to send one. log: what
    replay and learner logged since they started.
    """

    config: Config
    episodes: Sequence[Mapping[str, str]] = ()
    memory: ReplayMemory | None = None
    live: Snapshot | None = None
    log: Sequence[str] = ()

    def newest(self, column: str, count: int = RECENT) -> npt.NDArray[np.float64]:
        """The newest values of a column; NaN where nothing stands."""
        rows = self.episodes[-count:]
        return np.array([float(row.get(column) or "nan") for row in rows], np.float64)

    def last(self, column: str) -> float:
        """The newest value of a column that is known; 0 without one."""
        values = self.newest(column)
        return float(values[~np.isnan(values)][-1:].sum())


def findings(seen: Evidence) -> list[Finding]:
    """Everything that is found, causes before what follows from them."""
    texts = tomllib.loads(Path(__file__).with_name("illnesses.toml").read_text())
    told = [*_live(seen), *_samples(seen), *_training(seen), *_kept(seen), *_driving(seen)]
    return [Finding(name, measured, **texts[name]) for there, name, measured in told if there]


def _live(seen: Evidence) -> Told:
    refused, live = [line for line in seen.log if " is refused: " in line], seen.live or Snapshot()
    for name, heard in (("learner", live.learner), ("replay", live.replay)):
        silent = heard is None or heard.age_s > 2.0 + 3 * seen.config.bus.heartbeat_s
        measured = f"silent for {heard.age_s:.0f} s" if heard else "not heard"
        yield silent and seen.live is not None, f"{name} stopped", measured
    for name, robot in live.robots.items():
        state, why = robot.message.state, robot.message.reason
        stands = state in ("estop", "paused", "blocked")
        yield stands, "robot stands", f"{name}: {state} {why}".strip()
    lost = [actor.message.refused_episodes for actor in live.actors.values()]
    count = max([len(refused), *lost, live.replay.message.refused if live.replay else 0])
    why = (refused or ["see logs/replay.log"])[-1].split(" is refused: ")[-1]
    yield count > 0, "samples refused", f"{count} episodes, the last one because of {why}"


def _samples(seen: Evidence) -> Told:
    """What the newest pictures, actions and places tell."""
    memory, horizon = seen.memory, seen.config.episode.horizon
    if memory is None or len(memory) < PICTURES // 4:
        return
    ranks = np.arange(max(0, len(memory) - PICTURES), len(memory))
    images, rows = memory.images(ranks), memory.rows[ranks]
    bright, contrast = np.median(images.mean((1, 2))), np.median(images.std((1, 2)))
    yield bool(bright < 15), "camera too dark", f"brightness {bright:.0f} of 255"
    blank = bool(bright >= 15 and contrast < 5)
    yield blank, "camera shows nothing", f"contrast {contrast:.0f} of 255"
    moved = np.hypot(np.diff(rows["x_m"]), np.diff(rows["y_m"])) > 1e-3
    pairs = moved & (np.diff(rows["id"].astype(np.int64)) == 1)
    same = float((images[1:] == images[:-1]).all((1, 2))[pairs].sum() / max(pairs.sum(), 50))
    yield same > 0.3, "camera frozen", f"{same:.0%} of the pictures equal the one before"
    if not len(rows := memory.rows[memory.rows["episode"] > 0][-DRIVEN:]):  # it is being filled
        return
    counts = np.bincount(rows["action"], minlength=len(SHORT_NAMES))
    for name, count in zip(SHORT_NAMES, counts, strict=True):
        never = len(rows) >= 300 and count < 0.005 * len(rows)
        yield never, "action never taken", f"{name}: {count} of the newest {len(rows)} actions"
    ids = rows["id"] + np.uint64(horizon)
    then = rows[np.minimum(np.searchsorted(rows["id"], ids), len(ids) - 1)]
    pairs = (then["id"] == ids) & (then["commit"] == rows["commit"])
    pairs &= then["step"] == rows["step"] + horizon
    way_m = np.hypot(then["x_m"] - rows["x_m"], then["y_m"] - rows["y_m"])[pairs]
    most_m, robot = seen.config.max_distance_m, seen.config.robot
    near_m = min(max(0.2 * most_m, 3 * robot.step_m / robot.step_rad), 0.4 * most_m)
    near = float(np.sum(way_m < near_m) / max(len(way_m), 50))  # wider than the tightest circle
    yield near > 0.5, "robot circles", f"{near:.0%} of {horizon} actions lead back to their start"


def _training(seen: Evidence) -> Told:
    """Whether training goes on as the settings say, and does better than a constant prediction."""
    learning, steps = seen.config.learning, seen.newest("train_steps", 10 * RECENT)
    every = 1.0 if learning.mini_batches_per_episode else float(learning.fit_every or np.inf)
    if learning.fit_every_actions and every > 1.0 and len(steps):
        every = max(1.0, learning.fit_every_actions / float(np.mean(seen.newest("actions"))))
    lag = learning.max_lag_episodes if learning.mode == "asynchronous" else 0
    grew = np.flatnonzero(np.diff(np.fmax.accumulate(np.nan_to_num(steps))) > 0)
    idle = len(steps) - 2 - (int(grew[-1]) if len(grew) else -1)
    alone = len({row["stage"] for row in seen.episodes}) < 2  # other stages have other settings
    stopped = alone and idle >= max(3 * every + 10, lag)
    yield stopped, "learner stopped", f"no training for {idle} episodes"
    others = len({row["robot"] for row in seen.episodes[-11:]}) - 1  # their episodes come between
    behind = seen.newest("weights_version", 11)[:-1] - seen.newest("acting_version", 11)[1:]
    old, age = float(np.nan_to_num(behind).min(initial=np.inf)), seen.last("target_age")
    stale = len(behind) == 10 and old > lag + others
    yield stale, "weights stale", f"they are {old:.0f} versions old"
    yield age > RECENT, "weights stale", f"the target network is {age:.0f} episodes old"
    rewards = seen.memory.rows["reward"] if seen.memory is not None else np.zeros(0)
    nothing, constant = (np.mean(rewards**2), np.var(rewards)) if len(rewards) else (1.0, np.inf)
    losses = seen.newest("loss", 10 * RECENT)
    losses = losses[~np.isnan(losses)]
    loss = float(np.median(losses[-5:])) if len(losses) > 2 else 0.0
    diverged = [line for line in seen.log if "lower learning.learning_rate" in line]
    high, text = bool(diverged or loss > 1.5 * nothing), f"loss {loss:.3g}"
    yield high, "learning rate too high", (diverged or [text])[-1]
    flat = bool(not high and loss > 0.9 * constant > 0.0 and seen.last("train_steps") >= 300)
    yield flat, "loss does not fall", f"{text}, a constant reaches {constant:.3g}"


def _kept(seen: Evidence) -> Told:
    """What is kept, what goes, and what becomes of rewards."""
    memory, capacity = seen.config.memory, seen.last("capacity")
    names = ("actions", "discarded", "last_resort", "equalised", "recomputed")
    driven, gone, by_age, times, found = (float(np.nansum(seen.newest(name))) for name in names)
    lost = 1 - float(seen.newest("samples").sum()) / max(driven, 500)
    yield lost > 0.2 and driven > 500, "samples lost", f"{lost:.0%} of {driven:.0f} actions"
    threshold, share = seen.last("threshold_percent"), by_age / max(gone, 100)
    often = len(seen.episodes) >= LEAST and found > 0.3 * len(seen.newest("recomputed"))
    capped = often and threshold >= memory.threshold_max_percent > memory.threshold_percent
    yield capped, "threshold at its cap", f"{threshold:.0f} percent, and searches find too little"
    yield share > 0.2, "candidates run out", f"{share:.0%} of what was discarded went by age"
    every, between = len(seen.newest("episode")) / max(times, 1), driven / max(times, 1)
    often = times >= 3 and every < 10 and between < 0.08 * capacity
    yield often, "equalising too often", f"every {every:.1f} episodes, {between:.0f} actions"
    counts = [int(seen.last(name)) for name in SHORT_NAMES]
    uneven = len(seen.episodes) >= LEAST and min(counts) < 0.03 * sum(counts)
    yield uneven, "memory out of balance", by_action(counts)
    held = samples_by_world(seen.episodes[-1]["by_world"] if seen.episodes else "")
    for world in dict.fromkeys(row["world"] for row in seen.episodes):
        came = sum(int(row["samples"] or 0) for row in seen.episodes if row["world"] == world)
        forgot = came > 0.1 * capacity and held.get(world, 0) < 0.02 * sum(held.values())
        yield forgot, "memory of one world only", f"{held.get(world, 0)} samples of {world}"


def _driving(seen: Evidence) -> Told:
    """Whether episodes are more than chance would give, and come in time."""
    actions, seconds = seen.newest("actions"), seen.newest("seconds")
    if len(actions) < LEAST:
        return
    share, mean = float(np.mean(actions == 1)), float(np.mean(actions))
    yield share > 0.2, "bumps at once", f"{share:.0%} of the newest episodes had a single action"
    trained = seen.last("fits") >= 10 or seen.last("train_steps") >= 3000
    yield trained and mean < 15, "no better than chance", f"{mean:.0f} actions an episode"
    rate = float(np.median(actions[1:] / np.maximum(np.diff(seconds), 1e-3)))
    busy = np.nansum(seen.newest("turn_seconds")) / max(seconds[-1] - seconds[0], 1.0)
    yield rate < 1.0, "too slow", f"{rate:.2f} actions per second, {busy:.0%} of the time trains"
