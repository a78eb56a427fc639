"""The way of a drive on the top view of its corridor (Fig 4.20)."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.figures.style import GREEN, GREY, INK, SWITCH, WIDTH_IN, sheet, styled
from experiments.runs import Route
from services.robot_driver.world import World

_FREE, _SOLID, _WAY = "#f7f6f2", "#cececa", "#0072B2"
HIGHEST_IN = 6.0
LABEL_GAP_PT = 11
"""Distance of an event's number from its place, so that the way stays visible."""


@styled
def route(drive: Route, world: World) -> Figure:
    """Walls, way, start, end, bumps and numbered events; metres on both axes."""
    x0, y0, x1, y1 = world.bounds
    height = (WIDTH_IN - 0.7) * (y1 - y0) / (x1 - x0) + 0.9
    figure = sheet(min(height, HIGHEST_IN))
    axes = figure.subplots()
    axes.set_facecolor(_SOLID)
    for wall in world.walls:
        x, y = np.array(wall.points).T
        face = _FREE if wall.area_m2 > 0.0 else _SOLID
        axes.fill(x, y, facecolor=face, edgecolor=INK, linewidth=1.0)
    _way(axes, drive)
    axes.set_aspect("equal")
    margin = 0.02 * (x1 - x0)
    axes.set_xlim(x0 - margin, x1 + margin)
    axes.set_ylim(y0 - margin, y1 + margin)
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.grid(visible=False)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def _way(axes: Axes, drive: Route) -> None:
    x, y = drive.places_m.T
    axes.plot(x, y, color=_WAY, linewidth=1.2, label=f"way of {len(drive.bumps)} actions")
    axes.plot(x[0], y[0], "o", color=GREEN, markersize=7, label="start")
    axes.plot(x[-1], y[-1], "s", color=INK, markersize=6, label="end")
    hits = drive.places_m[1:][drive.bumps]
    axes.plot(*hits.T, "x", color=SWITCH, markersize=7, markeredgewidth=2,
              label=f"bumps ({len(hits)})")  # fmt: skip
    for event in drive.events:
        place = drive.places_m[min(event.action, len(drive.bumps))]
        axes.annotate(
            str(event.number),
            (float(place[0]), float(place[1])),
            textcoords="offset points",
            xytext=(LABEL_GAP_PT, LABEL_GAP_PT),
            ha="center",
            va="center",
            arrowprops={"arrowstyle": "-", "color": GREY, "shrinkB": 0},
            bbox={"boxstyle": "circle,pad=0.25", "facecolor": "white", "edgecolor": INK},
            fontsize=8,
        )
