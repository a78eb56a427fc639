"""The way of drives: on disk, and drawn on the top view of their world."""

import json
import zipfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon, Rectangle

from experiments.drives.traces import Trace
from services.robot_driver.simulated.world import World
from shared.errors import StateError

WIDTH_IN = 7.5
LEGEND_IN = 1.1
DPI = 150
SCALE_M = 2
EVENT_GAP_PT = 13
"""Distance of an event's number from its place, so that the way stays visible."""
EVENTS_APART_M = 0.7
"""Events closer to each other share a label."""
_FREE, _SOLID, _INK, _BOX = "#f7f6f2", "#cececa", "#282c34", "#a9825a"
_BUMP, _START, _END = "#d55e00", "#009e73", "#282c34"
_WAY = "#0072b2"


class Event(NamedTuple):
    """Something worth telling that happened on a drive."""

    number: int
    action: int
    """Actions driven before it."""
    text: str


class Route(NamedTuple):
    """One drive with its events."""

    trace: Trace
    events: tuple[Event, ...] = ()


def write(path: Path, route: Route) -> None:
    """Write a drive as named arrays, without anything that would be executed when read."""
    trace = route.trace
    np.savez_compressed(
        path,
        world=np.array(trace.world),
        bumps=trace.bumps,
        places_m=trace.places_m,
        headings_rad=trace.headings_rad,
        way_m=trace.way_m,
        laps=np.array([trace.laps_left, trace.laps_right]),
        events=np.array(json.dumps([event._asdict() for event in route.events])),
    )


def read(path: Path) -> Route:
    """A drive as it was written. Raises StateError if it is missing, damaged or something else."""
    try:
        with np.load(path, allow_pickle=False) as file:
            left, right = (int(count) for count in file["laps"])
            trace = Trace(
                world=str(file["world"]),
                bumps=np.asarray(file["bumps"], np.bool_),
                places_m=_floats(file["places_m"], 2),
                headings_rad=_floats(file["headings_rad"]),
                way_m=_floats(file["way_m"]),
                laps_left=left,
                laps_right=right,
            )
            events = tuple(Event(**each) for each in json.loads(str(file["events"])))
    except (OSError, EOFError, KeyError, TypeError, ValueError, zipfile.BadZipFile) as error:
        raise StateError(f"{path}: not the route of a drive: {error}") from error
    n = len(trace.bumps)
    sizes = len(trace.places_m), len(trace.headings_rad), len(trace.way_m)
    if sizes != (n + 1, n + 1, n):
        raise StateError(f"{path}: expected places, headings, ways of {n} actions, got {sizes}")
    return Route(trace, events)


def figure(
    world: World, traces: Sequence[Trace], title: str, events: Sequence[Event] = ()
) -> Figure:
    """Drives on the top view of their world: ways, starts, ends and bumps (Fig 4.20).

    The events are those of the first drive; their numbers stand beside the way.
    """
    sheet, (x0, y0, x1, y1) = Figure(dpi=DPI, layout="constrained"), world.bounds
    sheet.set_size_inches(WIDTH_IN, WIDTH_IN * (y1 - y0) / (x1 - x0) + LEGEND_IN)
    axes = sheet.subplots()
    _draw_world(axes, world)
    thin = len(traces) > 1
    axes.add_collection(LineCollection(
        [part for trace in traces for part in _driven(trace)],
        colors=_WAY, linewidths=0.9 if thin else 1.5, alpha=0.6 if thin else 1.0, zorder=3,
    ))  # fmt: skip
    marks = [
        (np.array([t.places_m[0] for t in traces]), "o", _START, "start"),
        (np.array([t.places_m[-1] for t in traces]), "s", _END, "end"),
        (np.concatenate([bump_places(trace) for trace in traces]), "x", _BUMP, "bump"),
    ]
    for places, marker, colour, _ in marks:
        axes.plot(*places.T, marker, color=colour, markersize=6, markeredgewidth=1.6, zorder=4)
    _scale_bar(sheet, world)
    margin = 0.15
    axes.set(xlim=(x0 - margin, x1 + margin), ylim=(y0 - 0.75, y1 + margin), aspect="equal")
    axes.set_axis_off()
    axes.add_patch(Rectangle((0, 0), 1, 1, transform=axes.transAxes, facecolor=_SOLID, zorder=-1))
    axes.set_title(title, fontsize=10, color=_INK)
    sheet.legend(handles=_legend(traces, marks), loc="outside lower center", ncols=4, fontsize=9)
    _mark(axes, traces[0], events)
    return sheet


def _draw_world(axes: Axes, world: World) -> None:
    """Walls and boxes, seen from above."""
    axes.set_facecolor(_SOLID)
    for wall in world.walls:
        face = _FREE if wall.area_m2 > 0.0 else _SOLID
        axes.add_patch(Polygon(wall.points, facecolor=face, edgecolor=_INK, linewidth=1.2))
    for obstacle in world.obstacles:
        axes.add_patch(Polygon(obstacle.corners, facecolor=_BOX, edgecolor=_INK, linewidth=0.8))


def _mark(axes: Axes, trace: Trace, events: Sequence[Event]) -> None:
    for (x, y), numbers in gathered(trace, events):
        axes.annotate(
            ranges(numbers), (x, y), textcoords="offset points",
            xytext=(EVENT_GAP_PT, EVENT_GAP_PT), ha="center", va="center", fontsize=8, zorder=5,
            arrowprops={"arrowstyle": "-", "color": _INK, "shrinkB": 0},
            bbox={"boxstyle": "round,pad=0.25", "facecolor": "white", "edgecolor": _INK},
        )  # fmt: skip


def gathered(trace: Trace, events: Sequence[Event]) -> list[tuple[tuple[float, float], list[int]]]:
    """Places of events in metres with the numbers of all that happened close by."""
    groups: list[tuple[tuple[float, float], list[int]]] = []
    for event in events:
        x, y = (float(part) for part in trace.places_m[min(event.action, len(trace.bumps))])
        near = [n for (gx, gy), n in groups if np.hypot(gx - x, gy - y) <= EVENTS_APART_M]
        if near:
            near[0].append(event.number)
        else:
            groups.append(((x, y), [event.number]))
    return groups


def ranges(numbers: Sequence[int]) -> str:
    """Ascending numbers, neighbours as one, no more than three: "3, 5-7", "1, 3, 5 ..."."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][-1] + 1:
            parts[-1] = [parts[-1][0], number]
        else:
            parts.append([number])
    told = ", ".join("-".join(map(str, part)) for part in parts[:3])
    return f"{told} ..." if len(parts) > 3 else told


def bump_places(trace: Trace) -> npt.NDArray[np.float64]:
    """Where the middle of the robot was when it bumped, float64 [bumps, 2]; turns are neglected."""
    at = np.flatnonzero(trace.bumps)
    heading, way_m = trace.headings_rad[at], trace.way_m[at]
    ahead = np.column_stack([np.cos(heading), np.sin(heading)]) * way_m[:, None]
    return np.asarray(trace.places_m[at] + ahead)


def _driven(trace: Trace) -> list[npt.NDArray[np.float64]]:
    """The way in pieces, interrupted where the robot recovered from a bump."""
    bumps, places = np.flatnonzero(trace.bumps), bump_places(trace)
    pieces = []
    for number, piece in enumerate(np.split(trace.places_m, bumps + 1)):
        hit = places[number : number + 1]  # none after the last piece
        pieces.append(np.vstack([piece, hit]))
    return pieces


def _legend(
    traces: Sequence[Trace], marks: Sequence[tuple[npt.NDArray[np.float64], str, str, str]]
) -> list[Line2D]:
    def counted(count: int, name: str) -> str:
        return f"{count} {name}{'' if count == 1 else 's'}"

    actions = sum(len(trace.bumps) for trace in traces)
    label = f"{counted(len(traces), 'drive')}, {actions} actions"
    mark = partial(Line2D, [], [], linestyle="", markeredgewidth=1.6)
    return [
        Line2D([], [], color=_WAY, label=label),
        *(mark(color=c, marker=m, label=counted(len(at), name)) for at, m, c, name in marks),
    ]


def _scale_bar(figure: Figure, world: World) -> None:
    axes, (x0, y0, _, _) = figure.axes[0], world.bounds
    for metre in range(SCALE_M):
        face = _INK if metre % 2 == 0 else "white"
        axes.add_patch(Rectangle((x0 + metre, y0 - 0.5), 1.0, 0.12, facecolor=face, edgecolor=_INK))
    axes.text(x0 + SCALE_M + 0.15, y0 - 0.44, f"{SCALE_M} m", va="center", fontsize=9, color=_INK)


def _floats(array: npt.NDArray[np.generic], *row: int) -> npt.NDArray[np.float64]:
    """The array, if it is float64 [n, *row] and finite. Raises ValueError."""
    if array.dtype != np.float64 or array.shape[1:] != row or not np.isfinite(array).all():
        raise ValueError(f"expected finite float64 {['n', *row]}, got {array.dtype} {array.shape}")
    return np.asarray(array, np.float64)
