"""What a run of an experiment leaves behind: file names and columns, for writers and readers alike.

    <out>/<experiment>-<scale>/seed-<n>/
        run.json           what was run: command, commit, machine, seed, seconds, stages, progress
        config.toml        the configuration of the first stage
        episodes.csv       one row per counted episode
        evaluations.csv    one row per drive without learning (frozen network, greedy)
        probes-<label>.npz images of a fixed set, and the rewards predicted for them
        route-<label>.npz  the way of one drive
        tours.json         how every test drive went (A45)
        weights.safetensors, best.safetensors
        state-<stage>/     everything a later stage or experiment goes on from

Every column but `seconds` is a function of the configuration, the seed and the numerics.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from shared.facts import SHORT_NAMES

Value = int | float | str
Row = Mapping[str, Value]

EPISODE_COLUMNS = (
    "episode",  # global number, 1 for the first one after the memory was filled
    "stage",
    "world",
    "ended",  # bump, full or interrupted
    "bump",
    "fitness",  # A37, E10
    "actions",  # new ones of this episode
    "total_actions",  # of counted episodes
    "bumps",  # so far
    "laps_left",  # so far, anticlockwise
    "laps_right",
    "longest_run_actions",  # so far
    "mini_batches",  # trained at this episode
    "loss",  # their mean; empty without any
    "fitting",  # 1 if this was a fitting phase
    "train_steps",
    "fits",
    "weights_version",
    "target_age",  # episodes since the target network was copied
    "memory",
    "capacity",
    *SHORT_NAMES,  # samples in the memory by action
    "by_world",  # samples in the memory by corridor: "plus=2000 minus=1333"
    "discarded",
    "last_resort",  # of those, by age because candidates ran out (E21)
    "recomputed",
    "equalised",
    "threshold_percent",
    "seconds",  # wall time so far without evaluations
)
EVALUATION_COLUMNS = (
    "label",  # why: "every", "stage <name>", "end"; of the floor and the ceiling: "reference"
    "driver",  # network, random or planner
    "stage",
    "episode",
    "total_actions",
    "train_steps",
    "world",
    "actions",
    "bumps",
    "bumps_per_1000",
    "bumps_per_100m",
    "mean_run",  # actions between bumps
    "longest_run",
    "fitness",  # A37
    "laps_left_per_1000",
    "laps_right_per_1000",
    "distance",  # from where it was 50 actions ago, as a part of the farthest possible
    "coverage",  # part of the free cells of the world visited
    "circling",  # part of the time
    "seconds",  # wall time of learning until then
)
WALL_TIME = "seconds"
"""The one column that two runs of the same seed may differ in."""


class MemoryRecord(BaseModel):
    """What the memory was made of as `run.json` was written: its entry `memory`."""

    model_config = ConfigDict(frozen=True)

    of_fill: float = Field(ge=0.0, le=1.0)
    """Share of the samples that it was filled with before there were episodes."""
    negative: float = Field(ge=0.0, le=1.0)
    """Share with a reward below 0: a bump ahead."""
    mean_reward: float = Field(ge=-1.0, le=1.0)


class TourRecord(BaseModel):
    """One test drive with turns on the spot (A45): an entry of `tours.json`."""

    model_config = ConfigDict(frozen=True)

    passed: bool
    """Full, past the box, and without a bump."""
    driven: int = Field(ge=0)
    """Actions, turns on the spot not counted."""
    turned: int = Field(ge=0)
    bumps: int = Field(ge=0)
    route_share: float = Field(ge=0.0, le=1.0)
    bridges: tuple[str, ...]
    box_dropped: bool


def write_csv(path: Path, columns: tuple[str, ...], rows: Iterable[Row]) -> None:
    """Write a table whole or not at all. Raises ValueError for a row with an unknown column."""
    temporary = path.with_name(f".{path.name}.new")
    with temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    os.replace(temporary, path)


def append_csv(path: Path, columns: tuple[str, ...], rows: Iterable[Row]) -> None:
    """Append rows; the header is written first where there is no file yet."""
    if not path.exists():
        write_csv(path, columns, ())
    with path.open("a", newline="", encoding="utf-8") as file:
        csv.DictWriter(file, columns, lineterminator="\n").writerows(rows)


def read_csv(path: Path, columns: tuple[str, ...]) -> list[dict[str, str]]:
    """All rows of a table; none where there is no file.

    A torn last line is left out.

    Raises:
        ValueError: The header is another one.
    """
    if not path.exists():
        return []
    with path.open("r", newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        if tuple(reader.fieldnames or ()) != columns:
            raise ValueError(f"{path}: expected the columns {', '.join(columns)}")
        return [row for row in reader if row[columns[-1]]]


def by_world(text: str) -> dict[str, int]:
    """Samples by corridor, of a `by_world` field."""
    pairs = (part.split("=") for part in text.split())
    return {name: int(count) for name, count in pairs}
