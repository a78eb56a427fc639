"""What a run of an experiment leaves behind: file names and columns, for writers and readers alike.

    <out>/<experiment>-<scale>/seed-<n>/
        run.json           what was run: command, commit, machine, seed, seconds, stages, progress
        config.toml        the configuration of the first stage
        episodes.csv       one row per counted episode (`shared/run_record.py`, as is run.json)
        evaluations.csv    one row per drive without learning (frozen network, greedy)
        probes-<label>.npz images of a fixed set, and the rewards predicted for them
        route-<label>.npz  the way of one drive
        tours.json         how every test drive went (A45)
        weights.safetensors, best.safetensors
        state-<stage>/     everything a later stage or experiment goes on from

Every column but `seconds` is a function of the configuration, the seed and the numerics.
"""

from pydantic import BaseModel, ConfigDict, Field

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
    "wall_value",  # of drives that explore: mean prediction of actions that soon hit a wall
    "value_rank",  # of the same: rank correlation of predictions with observed rewards
    "value_slope",  # and slope of the rewards over the predictions
    "seconds",  # wall time of learning until then
)
WALL_TIME = "seconds"
"""The one column that two runs of the same seed may differ in."""


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
