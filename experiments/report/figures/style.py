"""How figures look: sizes, a palette that colour-blind people can tell apart, stages."""

import io
from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from itertools import pairwise
from typing import ParamSpec

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from experiments.report.statistics import Band
from shared.facts import SHORT_NAMES
from shared.run_record import StageInfo

P = ParamSpec("P")

WIDTH_IN = 6.5
"""Text width of a page; fonts are sized for it."""
DPI = 130
INK, GREY, SWITCH = "#222222", "#8a8a8a", "#c1272d"
GREEN = "#009E73"
PALETTE = (
    "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#000000", "#8c564b",
)  # fmt: skip
"""Colours of experiments, corridors and actions, in the order in which a figure shows them."""
_RC = {
    "font.size": 8.5,
    "axes.titlesize": 9.0,
    "axes.labelsize": 8.5,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": INK,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "savefig.dpi": DPI,
}


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Make a function draw in our style, however matplotlib is configured."""

    @wraps(draw)
    def inner(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with rc_context(_RC):  # type: ignore[arg-type]
            return draw(*args, **kwargs)

    return inner


def sheet(height_in: float) -> Figure:
    """An empty figure of page width; what is put on it arranges itself."""
    return Figure(figsize=(WIDTH_IN, height_in), layout="constrained")


def png(figure: Figure) -> bytes:
    """The picture as PNG of at most 256 colours, half as large; equal figures give equal bytes."""
    drawn, file = io.BytesIO(), io.BytesIO()
    with rc_context(_RC):  # type: ignore[arg-type]
        figure.savefig(drawn, format="png")
    with Image.open(drawn) as picture:
        fewer = picture.convert("RGB").quantize(256, dither=Image.Dither.NONE)
    fewer.save(file, format="png", optimize=True)
    return file.getvalue()


def colours(names: Iterable[str]) -> dict[str, str]:
    """A colour for each name, in their order; they repeat where there are too many names."""
    return {name: PALETTE[i % len(PALETTE)] for i, name in enumerate(names)}


ACTION_COLOURS = colours(SHORT_NAMES)


def draw_band(axes: Axes, band: Band, colour: str, label: str) -> None:
    """Median as a line, lowest to highest seed as an area."""
    marker = "o" if len(band.x) < 3 else ""
    low, median, high = band.levels
    axes.plot(band.x, median, color=colour, label=label, marker=marker, markersize=3)
    if band.seeds > 1:
        axes.fill_between(band.x, low, high, color=colour, alpha=0.2, linewidth=0)


def draw_stages(axes: Axes, stages: Sequence[StageInfo]) -> None:
    """Dashed lines between stages, red where the corridor changes, and their numbers on top."""
    for before, after in pairwise(stages):
        colour = GREY if before.world == after.world else SWITCH
        place = after.first_episode - 0.5
        axes.axvline(place, color=colour, linestyle="--", linewidth=1.0, zorder=1)
    if len(stages) > 1:
        top = axes.secondary_xaxis("top")
        middles = [(s.first_episode + (s.last_episode or s.first_episode)) / 2 for s in stages]
        top.set_xticks(middles, [str(i + 1) for i in range(len(stages))])
        top.tick_params(length=0, colors=GREY, pad=1)
        top.spines["top"].set_visible(False)
