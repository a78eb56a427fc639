"""What happened on drives, and figures of it: pure functions of arrays.

Circling on the spot bumps into nothing. That is why bumps never stand alone here: distance from
where the robot was, laps, coverage and circling tell whether it gets anywhere.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from experiments.drives.places import Cells
from services.robot_driver.simulated.world import World

Bools = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.float64]
Figures = dict[str, float]

FULL_RUN = 500
"""Longer runs count as this long in the fitness (A37)."""
CIRCLING_TURN_RAD = 2.0 * math.pi
CIRCLING_DISTANCE = 0.2
"""More turn and less distance than these within the horizon is circling."""


@dataclass(frozen=True)
class Trace:
    """One drive of n actions."""

    world: str
    bumps: Bools
    """[n]: whether there was contact."""
    places_m: Floats
    """[n + 1, 2]: x, y before the first action and after each, recovery included."""
    headings_rad: Floats
    """[n + 1], likewise."""
    way_m: Floats
    """[n]: how far each action led, recovery not included."""
    laps_left: int
    """Anticlockwise."""
    laps_right: int


def figures(traces: Sequence[Trace], cells: Cells, horizon: int, max_distance_m: float) -> Figures:
    """Figures of drives in one world, named as in `records.EVALUATION_COLUMNS`.

    Args:
        traces: At least one drive of at least one action.
        cells: The free cells of the world.
        horizon: Actions that the distance and circling look back (A15).
        max_distance_m: The farthest possible within the horizon.

    Returns:
        bumps_per_100m: per 100 m of way driven by actions.
        mean_run, longest_run: of `bump_free_runs`.
        fitness: their mean, each at most 500 (A37).
        distance: mean distance from `horizon` actions ago, as a part of the farthest possible.
        coverage: part of the free cells that some drive came to.
        circling: part of the actions with `horizon` others before them at which the robot circled.
    """
    actions = sum(len(trace.bumps) for trace in traces)
    bumps = sum(int(trace.bumps.sum()) for trace in traces)
    way_m = sum(float(trace.way_m.sum()) for trace in traces)
    runs = [run for trace in traces for run in bump_free_runs(trace.bumps)]
    far = np.concatenate([distances_m(t.places_m, horizon) for t in traces]) / max_distance_m
    circles = np.concatenate([circling(trace, horizon, max_distance_m) for trace in traces])
    return {
        "actions": actions,
        "bumps": bumps,
        "bumps_per_1000": 1000.0 * bumps / actions,
        "bumps_per_100m": _rate(100.0 * bumps, way_m),
        "mean_run": float(np.mean(runs)),
        "longest_run": max(runs),
        "fitness": float(np.mean(np.minimum(runs, FULL_RUN))),
        "laps_left_per_1000": 1000.0 * sum(trace.laps_left for trace in traces) / actions,
        "laps_right_per_1000": 1000.0 * sum(trace.laps_right for trace in traces) / actions,
        "distance": _mean(far),
        "coverage": cells.visited(np.concatenate([trace.places_m for trace in traces])),
        "circling": _mean(circles),
    }


def bump_free_runs(bumps: Bools) -> list[int]:
    """Lengths of the bump-free runs of a drive, without the bumping action.

    A run is what lies between two bumps, or a bump and the begin of the drive. One that the end of
    the drive cuts off counts too if it has begun.
    """
    ends = np.flatnonzero(bumps)
    lengths = np.diff(ends, prepend=-1) - 1
    rest = len(bumps) - (int(ends[-1]) + 1 if len(ends) else 0)
    return [*map(int, lengths), *([rest] if rest else [])]


def distances_m(places_m: Floats, horizon: int) -> Floats:
    """How far the robot is from where it was `horizon` actions ago, as soon as there is one."""
    way = places_m[horizon:] - places_m[: max(len(places_m) - horizon, 0)]
    return np.asarray(np.hypot(way[:, 0], way[:, 1]))


def circling(trace: Trace, horizon: int, max_distance_m: float) -> Bools:
    """Tell at which actions the robot circled: bool [n + 1 - horizon], empty for shorter drives.

    It circles if within the last `horizon` actions it turned by more than a full circle, net,
    without bumping, and is nearer to where it was before them than 20 % of the farthest possible.
    """
    turns = np.diff(trace.headings_rad)
    turns = np.remainder(turns + math.pi, 2.0 * math.pi) - math.pi
    turned = np.abs(_window_sums(turns, horizon))
    bumped = _window_sums(trace.bumps.astype(np.float64), horizon) > 0.5
    near = distances_m(trace.places_m, horizon) < CIRCLING_DISTANCE * max_distance_m
    return np.asarray((turned > CIRCLING_TURN_RAD) & near & ~bumped)


def first_lap(trace: Trace, world: World) -> int | None:
    """Actions after which a drive has gone once round the lap centre, either way round.

    None if it never does, or not before its first bump. Raises ValueError without a lap centre.
    """
    if world.lap is None:
        raise ValueError(f"world {world.name!r} has no lap centre")
    from_centre = trace.places_m - np.array(world.lap.centre)
    angle = np.unwrap(np.arctan2(from_centre[:, 1], from_centre[:, 0]))
    bumps = np.flatnonzero(trace.bumps)
    free = int(bumps[0]) if len(bumps) else len(trace.bumps)
    round_it = np.flatnonzero(np.abs(angle[: free + 1] - angle[0]) >= 2.0 * math.pi)
    return int(round_it[0]) if len(round_it) else None


def _window_sums(values: Floats, width: int) -> Floats:
    """Sums of `width` neighbours, float64 [n + 1 - width]; empty if there are fewer."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    return np.asarray(total[width:] - total[: max(len(total) - width, 0)])


def _rate(count: float, way_m: float) -> float:
    """Count per metre; infinite of bumps without any way."""
    if way_m > 0.0:
        return count / way_m
    return math.inf if count else 0.0


def _mean(values: Floats | Bools) -> float:
    """The mean; 0 of drives too short for a single value."""
    return float(values.mean()) if len(values) else 0.0
