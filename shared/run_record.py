"""What every run leaves behind about itself, whoever ran it: the services or an experiment.

    run.json        what was run: command, commit, machine, seed, start, stages
    episodes.csv    one row for each counted episode
    training.csv    one row for each turn of the learner service

An experiment writes one table. Of the services, replay writes `episodes.csv` without the columns
that only the learner knows; those of `training.csv` are joined by episode as a run is read.
"""

from __future__ import annotations

import csv
import errno
import io
import shlex
import sys
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from shared.facts import SHORT_NAMES
from shared.provenance import machine
from shared.rl.retention.table import TELLS
from shared.statefile import create, needing_room, write_atomically

if TYPE_CHECKING:
    from shared.config import Config
    from shared.rl.memory import ReplayMemory
    from shared.rl.turn import Maintenance

Row = Mapping[str, int | float | str]

RUN, EPISODES, TRAINING = "run.json", "episodes.csv", "training.csv"
SERVICES = "services"
"""What stands in place of a scale in `run.json` of a run of the services."""
STAGE = "run"
"""The one stage of such a run."""
EPISODE_COLUMNS = (
    "episode",  # global number, 1 for the first one after the memory was filled
    "stage",
    "world",
    "robot",
    "ended",  # bump, full or interrupted
    "bump",
    "fitness",  # A37, E10
    "actions",  # new ones of this episode
    "total_actions",  # of counted episodes
    "bumps",  # so far
    "laps_left",  # so far, anticlockwise
    "laps_right",
    "longest_run_actions",  # so far
    "samples",  # brought into the memory
    "mini_batches",  # trained at this episode
    "loss",  # their mean; empty without any
    "fitting",  # 1 if this was a fitting phase
    "train_steps",
    "fits",
    "weights_version",  # of the target network after this episode
    "target_age",  # episodes since the target network was copied
    "acting_version",  # of the target network that computed the rewards
    "memory",
    "capacity",
    *SHORT_NAMES,  # samples in the memory by action
    "by_world",  # samples in the memory by corridor: "plus=2000 minus=1333"
    "discarded",
    "equalised",
    *TELLS,  # what the strategies of retention tell of a turn
    "seconds",  # wall time so far without evaluations; a services run: while replay was up
)
"""Columns of `episodes.csv`. A table may lack some; they are read as empty."""
TRAINING_COLUMNS = (
    "episode",
    "mini_batches",
    "loss",
    "fitting",
    "train_steps",
    "fits",
    "weights_version",
    "target_age",
    "turn_seconds",  # wall time of pulling the changes and of training
)
"""Columns of `training.csv`."""
REPLAY_COLUMNS = tuple(c for c in EPISODE_COLUMNS if c not in TRAINING_COLUMNS[1:])
"""Columns of `episodes.csv` as the replay service writes it."""


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True)


class MemoryRecord(_Record):
    """What the memory was made of as `run.json` was written."""

    of_fill: float = Field(ge=0.0, le=1.0)
    """Share of the samples that it was filled with before there were episodes."""
    negative: float = Field(ge=0.0, le=1.0)
    """Share with a reward below 0: a bump ahead."""
    mean_reward: float = Field(ge=-1.0, le=1.0)


class StageInfo(_Record):
    """A part of a run with settings of its own; episodes are counted globally."""

    name: str
    world: str
    first_episode: int
    last_episode: int | None = None
    """None while the stage goes on."""
    actions: int | None = None
    """None likewise, and so are those below."""
    train_steps: int | None = None
    seconds: float | None = None


class RunInfo(_Record):
    """`run.json`: what was run, where, and how far it got."""

    experiment: str
    """The plan; of a run of the services, its name."""
    title: str
    source: str = ""
    """Where the thesis describes it."""
    scale: str
    """Name of the scale of an experiment; `services` for a run of the services."""
    factor: float = Field(default=1.0, gt=0.0)
    """How many times smaller than in the thesis memories and numbers of actions are."""
    seed: int
    after: str = ""
    """The experiment whose end this one began with; empty for none."""
    command: str
    commit: str
    machine: str
    python: str
    torch: str
    numerics: dict[str, Any] = Field(default_factory=dict)
    """Devices, engines and precision that the roles computed with."""
    started: str
    finished: str = ""
    """Empty while the run goes on."""
    complete: bool = False
    seconds: float = 0.0
    """A run of the services leaves it and the counts at 0: its tables tell them."""
    episodes: int = 0
    """Counted ones of this run alone."""
    one_action_share: float = Field(default=0.0, ge=0.0, le=1.0)
    """Share of those that lasted a single action (E11)."""
    actions: int = 0
    """Actions so far, with those of predecessors."""
    fill_actions: int = 0
    """Actions that filled the memory, counted likewise."""
    train_steps: int = 0
    """Gradient steps, counted likewise."""
    longest_run: int = 0
    """Most actions without a bump in this run (E10, E43)."""
    prefill: str = ""
    """Hash of the memory as the first episode began; empty for what keeps no such memory."""
    first_lap: dict[str, float] = Field(default_factory=dict)
    """When the frozen network first drove a lap; empty if it has not, or nobody looked."""
    memory: MemoryRecord | None = None
    """None for what keeps no such memory."""
    stages: tuple[StageInfo, ...]
    thesis: dict[str, Any] = Field(default_factory=dict)
    """The thesis's numbers for this experiment, by the names of `measures.MEASURED`, or as text."""

    def to_json(self) -> bytes:
        """Content of `run.json`."""
        return (self.model_dump_json(indent=2) + "\n").encode()


def made_here() -> dict[str, str]:
    """The fields of `RunInfo` that tell with what and on what a run is made."""
    made = machine()
    return {
        "commit": made["commit"],
        "machine": f"{made['cpu']}, {made['cores']} cores",
        "python": made["python"],
        "torch": made["torch"],
    }


def now_utc() -> str:
    """The time as it stands in `run.json`, to the second."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())


def begin(folder: Path, config: Config) -> None:
    """Write `run.json` of a run of the services, unless the folder has one already."""
    if (folder / RUN).exists():
        return
    info = RunInfo(
        experiment=config.run.name,
        title="Run of the services",
        scale=SERVICES,
        seed=config.run.seed,
        command=shlex.join(["corridor", *sys.argv[1:]]),
        **made_here(),
        started=now_utc(),
        stages=(StageInfo(name=STAGE, world=config.robot.world, first_episode=1),),
    )
    create(folder / RUN, info.to_json())


def turn_columns(memory: ReplayMemory, done: Maintenance) -> dict[str, int | str]:
    """The columns of an episode that tell the memory after its turn, and what the turn did."""
    by_world = np.bincount(memory.rows["world"], minlength=len(memory.worlds))
    counts = zip(memory.worlds, by_world, strict=True)
    discarded = done.discarded
    return {
        "memory": len(memory),
        "capacity": memory.capacity,
        **dict(zip(SHORT_NAMES, memory.by_action(), strict=True)),
        "by_world": " ".join(f"{name}={count}" for name, count in counts),
        "discarded": len(discarded.ids),
        "equalised": int(done.equalised),
        **discarded.told,
    }


def samples_by_world(text: str) -> dict[str, int]:
    """Samples by corridor, from a `by_world` field."""
    pairs = (part.split("=") for part in text.split())
    return {name: int(count) for name, count in pairs}


def write_csv(path: Path, columns: tuple[str, ...], rows: Iterable[Row]) -> None:
    """Write a table whole or not at all. Raises ValueError for a row with an unknown column."""
    head = ",".join(columns) + "\n"
    write_atomically(path, head.encode() + _lines(columns, rows))


def append_csv(path: Path, columns: tuple[str, ...], rows: Iterable[Row]) -> None:
    """Append rows, all or none; the header is written first where there is no file yet."""
    if not path.exists():
        write_csv(path, columns, ())
    data = _lines(columns, rows)
    with needing_room(path), path.open("ab", buffering=0) as file:
        end = file.tell()
        if file.write(data) != len(data):
            file.truncate(end)
            raise OSError(errno.ENOSPC, "no room for all rows")


def _lines(columns: tuple[str, ...], rows: Iterable[Row]) -> bytes:
    text = io.StringIO()
    csv.DictWriter(text, columns, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()


def read_csv(path: Path, columns: tuple[str, ...]) -> list[dict[str, str]]:
    """All rows of a table without a torn last line; none where there is no file.

    A column that the table lacks is empty. Raises ValueError for another first column, or one that
    is not among `columns`.
    """
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        found = tuple(reader.fieldnames or ("",))
        if found[0] != columns[0] or not set(found) <= set(columns):
            raise ValueError(f"{path}: expected the columns {', '.join(columns)}")
        absent = dict.fromkeys(columns, "")
        return [absent | row for row in reader if row[found[-1]]]


def read_episodes(folder: Path) -> list[dict[str, str]]:
    """All episodes of a run folder, with what the learner wrote about each. Raises ValueError."""
    training = {row["episode"]: row for row in read_csv(folder / TRAINING, TRAINING_COLUMNS)}
    episodes = read_csv(folder / EPISODES, EPISODE_COLUMNS)
    return [row | training.get(row["episode"], {}) for row in episodes]
