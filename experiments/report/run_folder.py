"""Runs of experiments and of the services as they lie on disk, read and checked.

`shared/run_record.py` and `experiments/records.py` tell what lies there. There is one folder per
seed; seeds of one experiment at one scale belong together.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import TypeAdapter, ValidationError

from experiments.drives import routes
from experiments.drives.routes import Route
from experiments.records import EVALUATION_COLUMNS, TourRecord
from experiments.runs import probes
from experiments.runs.probes import Probes
from shared.errors import ConfigError, StateError, first_problem
from shared.run_record import (
    RUN,
    SERVICES,
    RunInfo,
    StageInfo,
    read_csv,
    read_episodes,
    samples_by_world,
)

Floats = npt.NDArray[np.float64]
T = TypeVar("T")

LEAST_WINDOW = 10
"""Episodes that a point of a curve averages at the smallest scale."""
WINDOW = 100
"""Episodes that a point of a curve averages at full scale (A37)."""


_TOURS = TypeAdapter(tuple[TourRecord, ...])


@dataclass(frozen=True)
class Rows:
    """A table read from CSV."""

    rows: tuple[dict[str, str], ...]

    def __len__(self) -> int:
        return len(self.rows)

    def numbers(self, column: str) -> Floats:
        """A column as float64 [n]; NaN where nothing stands."""
        return np.array([float(row[column] or "nan") for row in self.rows], np.float64)

    def words(self, column: str) -> list[str]:
        """A column as text."""
        return [row[column] for row in self.rows]

    def where(self, **wanted: str) -> "Rows":
        """The rows in which columns have these values."""
        kept = (r for r in self.rows if all(r[name] == value for name, value in wanted.items()))
        return Rows(tuple(kept))


@dataclass(frozen=True)
class RunFolder:
    """One seed of an experiment, as its folder holds it."""

    folder: Path
    info: RunInfo
    episodes: Rows
    evaluations: Rows
    probes: dict[str, Probes]
    """What networks predict, by stage and world, or `best` and world."""
    routes: dict[str, Route]
    """The route of each drive, by its label."""
    tours: tuple[TourRecord, ...]
    """The test drives in the order of their starts. It is empty where the plan has none."""

    @property
    def window(self) -> int:
        """Episodes averaged into one point: 100 (A37), fewer at a smaller scale, at least 10."""
        return max(LEAST_WINDOW, round(WINDOW / self.info.factor))

    @property
    def actions(self) -> int:
        """Actions of this run's own episodes; `run.json` and evaluations count predecessors too.

        A baseline records no episodes and has no predecessor: `run.json` counts its actions alone.
        """
        if not len(self.episodes):
            return 0 if self.info.after else self.info.actions
        return int(np.nansum(self.episodes.numbers("actions")))

    @property
    def train_steps(self) -> int:
        """Gradient steps of this run alone: those since its first episode, and that one's."""
        steps = self.episodes.numbers("train_steps")
        if not len(steps):
            return 0 if self.info.after else self.info.train_steps
        known = np.flatnonzero(~np.isnan(steps))  # the learner may be some episodes behind
        if not len(known):
            return 0
        own_of_first = self.episodes.numbers("mini_batches")[known[0]]
        return int(steps[known[-1]] - steps[known[0]] + own_of_first)

    @property
    def one_action_share(self) -> float:
        """Share of this run's episodes that lasted a single action (E11); NaN without episodes."""
        actions = self.episodes.numbers("actions")
        return float(np.mean(actions == 1)) if len(actions) else float("nan")

    @cached_property
    def runs_without_bump(self) -> Floats:
        """Actions without a bump at the end of every episode, over episodes of this run (E10)."""
        lengths, length = [], 0.0
        actions, bumps = self.episodes.numbers("actions"), self.episodes.numbers("bump")
        for driven, bump in zip(actions, bumps, strict=True):
            length += driven
            lengths.append(length - bump)
            length *= 1 - bump
        return np.array(lengths, np.float64)

    @property
    def stages(self) -> tuple[StageInfo, ...]:
        """The stages so far; one that goes on ends with the newest episode."""
        newest = int(self.episodes.numbers("episode").max(initial=0.0))
        ends = (s.last_episode or max(newest, s.first_episode) for s in self.info.stages)
        pairs = zip(self.info.stages, ends, strict=True)
        return tuple(stage.model_copy(update={"last_episode": end}) for stage, end in pairs)

    @cached_property
    def samples_by_world(self) -> dict[str, Floats]:
        """Samples in the memory after every episode, by corridor: float64 [episodes] each."""
        counts = [samples_by_world(text) for text in self.episodes.words("by_world")]
        names = sorted({name for count in counts for name in count})
        return {name: np.array([float(c.get(name, 0)) for c in counts]) for name in names}

    def evaluated(self, world: str) -> "Rows":
        """Drives of the frozen network in a world, oldest first."""
        return self.evaluations.where(driver="network", world=world)


@dataclass(frozen=True)
class Experiment:
    """All seeds of one experiment at one scale, in order."""

    runs: tuple[RunFolder, ...]

    @property
    def first(self) -> RunInfo:
        """What stands in `run.json` of the lowest seed."""
        return self.runs[0].info

    @property
    def name(self) -> str:
        """Name without the scale."""
        return self.first.experiment

    @property
    def scale(self) -> str:
        """Name of the scale."""
        return self.first.scale

    @property
    def full_name(self) -> str:
        """Name and scale, as the folder is called."""
        return f"{self.name}-{self.scale}"

    @property
    def worlds(self) -> list[str]:
        """Worlds in which frozen networks were driven, sorted."""
        rows = (row for run in self.runs for row in run.evaluations.rows)
        return sorted({row["world"] for row in rows if row["driver"] == "network"})


def load(folders: Iterable[Path]) -> list[Experiment]:
    """Read runs from seed folders, folders of experiments, or folders of those.

    Returns:
        Experiments sorted by scale and name, seeds in order; a folder given twice counts once.

    Raises:
        ConfigError: A folder holds no run, or two folders the same seed of an experiment.
        StateError: A file is damaged or not what it should be.
    """
    groups: dict[tuple[str, str], dict[int, RunFolder]] = {}
    for folder in _seed_folders(folders):
        run = read_run(folder)
        seeds = groups.setdefault((run.info.scale, run.info.experiment), {})
        if run.info.seed in seeds:
            other = seeds[run.info.seed].folder
            raise ConfigError(f"{folder}: the same experiment and seed as {other}; give only one")
        seeds[run.info.seed] = run
    return [
        Experiment(tuple(run for _, run in sorted(seeds.items())))
        for _, seeds in sorted(groups.items())
    ]


def _seed_folders(folders: Iterable[Path]) -> list[Path]:
    found: dict[Path, None] = {}
    for folder in folders:
        inside = [folder / "run.json", *folder.glob("*/run.json"), *folder.glob("*/*/run.json")]
        here = sorted(path.parent.resolve() for path in inside if path.is_file())
        if not here:
            raise ConfigError(f"{folder}: expected the folder of a run, with run.json; found none")
        found.update(dict.fromkeys(here))
    return list(found)


def read_run(folder: Path) -> RunFolder:
    """Read one seed. Raises StateError naming the file that is not what it should be."""
    info, episodes = read_info(folder / RUN), _rows(lambda: read_episodes(folder))
    tours = folder / "tours.json"
    if info.scale == SERVICES:
        info = info.model_copy(update=_totals(episodes))
    return RunFolder(
        folder,
        info,
        episodes,
        _rows(lambda: read_csv(folder / "evaluations.csv", EVALUATION_COLUMNS)),
        {_label(path): probes.read(path) for path in sorted(folder.glob("probes-*.npz"))},
        {_label(path): routes.read(path) for path in sorted(folder.glob("route-*.npz"))},
        _checked(tours, _TOURS.validate_json) if tours.exists() else (),
    )


def read_info(path: Path) -> RunInfo:
    """Read and check `run.json`. Raises StateError."""
    return _checked(path, RunInfo.model_validate_json)


def _checked(path: Path, check: Callable[[bytes], T]) -> T:
    """What a file holds. Raises StateError."""
    try:
        return check(path.read_bytes())
    except OSError as error:
        raise StateError(f"{path}: {error}") from error
    except ValidationError as error:
        raise StateError(f"{path}: {first_problem(error)}") from error


def _label(path: Path) -> str:
    """What stands behind the kind in the name of a file."""
    return path.stem.partition("-")[2]


def _totals(episodes: Rows) -> dict[str, float]:
    """What `run.json` of a run of the services leaves to its tables: the largest number of each."""
    columns = {"seconds": "seconds", "actions": "total_actions", "train_steps": "train_steps"}
    found = {name: episodes.numbers(column) for name, column in columns.items()}
    return {
        name: float(np.nanmax(values)) if name == "seconds" else int(np.nanmax(values))
        for name, values in found.items()
        if np.any(~np.isnan(values))
    }


def _rows(read: Callable[[], list[dict[str, str]]]) -> "Rows":
    try:
        return Rows(tuple(read()))
    except (ValueError, OSError) as error:
        raise StateError(str(error)) from error
