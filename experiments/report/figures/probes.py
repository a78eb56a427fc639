"""Images and the rewards that networks predict for them (Fig 4.7, 4.10, 4.16, 4.17, 4.19)."""

import string
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from experiments.report.figures.style import ACTION_COLOURS, GREY, INK, sheet, styled
from experiments.report.run_folder import Experiment, Floats
from experiments.runs.probes import Probes
from shared.facts import ACTION_COUNT, ACTIONS, SHORT_NAMES

COLUMNS = 6
ORDER = sorted(range(ACTION_COUNT), key=lambda index: -ACTIONS[index].turn)
"""Actions as their bars stand: from the farthest left to the farthest right."""
SHOWN = [SHORT_NAMES[index] for index in ORDER]


def chosen(count: int, wanted: int) -> list[int]:
    """Indices spread evenly over a set of images, in its order."""
    return sorted({round(i) for i in np.linspace(0, count - 1, min(count, wanted))})


@styled
def predictions(probes: Probes, networks: Mapping[str, Floats], wanted: int) -> Figure:
    """Up to `wanted` images, below each what every network predicts, one row of bars each."""
    indices = chosen(len(probes.images), wanted)
    blocks = -(-len(indices) // COLUMNS)
    rows = 1 + len(networks)
    figure = sheet(blocks * (0.95 + 0.75 * len(networks)) + 0.35)
    ratios = [1.05] + [0.85] * len(networks)
    grid = figure.subplots(blocks * rows, COLUMNS, height_ratios=ratios * blocks, squeeze=False)
    for cell in range(blocks * COLUMNS):
        block, column = divmod(cell, COLUMNS)
        cells = [grid[block * rows + row, column] for row in range(rows)]
        if cell >= len(indices):
            for axes in cells:
                axes.set_axis_off()
            continue
        _image(cells[0], probes.images[indices[cell]], string.ascii_lowercase[cell])
        for axes, (title, values) in zip(cells[1:], networks.items(), strict=True):
            _bars(axes, values[indices[cell]], title if column == 0 else None)
    handles = [Patch(color=ACTION_COLOURS[name]) for name in SHOWN]
    figure.legend(handles, SHOWN, loc="outside lower center", ncols=ACTION_COUNT)
    return figure


def _image(axes: Axes, image: npt.NDArray[np.uint8], letter: str) -> None:
    height, width = image.shape
    axes.imshow(image, cmap="gray", vmin=0, vmax=255, extent=(0, width, height, 0))
    axes.set_xticks([])
    axes.set_yticks([])
    axes.grid(visible=False)
    axes.spines[["left", "bottom"]].set_visible(False)
    axes.text(0.04, 0.93, letter, transform=axes.transAxes, va="top", color="black",
              bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.2})  # fmt: skip


def _bars(axes: Axes, values: Floats, title: str | None) -> None:
    heights = [float(values[i]) for i in ORDER]
    axes.bar(
        range(ACTION_COUNT), heights, color=[ACTION_COLOURS[name] for name in SHOWN], width=0.75
    )
    axes.axhline(0.0, color=INK, linewidth=0.7)
    axes.set_ylim(-1.05, 1.05)
    axes.set_xlim(-0.6, ACTION_COUNT - 0.4)
    axes.set_xticks([])
    axes.set_yticks([-1, 0, 1], ["−1", "0", "1"] if title is not None else ["", "", ""])
    axes.spines["bottom"].set_visible(False)
    axes.tick_params(length=2, colors=GREY, labelcolor=INK)
    if title is not None:
        axes.set_ylabel(title)


class Choice(NamedTuple):
    """Predictions of one network, and whose they are."""

    seed: int
    weights: str
    """Which weights of that seed, in words."""
    probes: Probes


def last(experiment: Experiment, world: str) -> Choice | None:
    """Predictions at the end of the newest stage, of the lowest seed that has them."""
    for run in experiment.runs:
        for stage in reversed(run.info.stages):
            if found := run.probes.get(f"{stage.name}-{world}"):
                return Choice(run.info.seed, f"weights at the end of stage {stage.name}", found)
    return None


def best(experiment: Experiment, world: str) -> Choice | None:
    """Predictions by the weights of the longest way without a bump, of the lowest seed."""
    for run in experiment.runs:
        if found := run.probes.get(f"best-{world}"):
            return Choice(run.info.seed, "best weights", found)
    return None
