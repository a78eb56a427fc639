"""Fitness, loss and memory over episodes (Fig 4.4 to 4.6, 4.9, 4.11, 4.12, 4.14, 4.15)."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.report.figures import style
from experiments.report.figures.style import GREEN, GREY
from experiments.report.run_folder import Experiment, Floats, RunFolder
from experiments.report.statistics import Band, Curve, band_of_blocks, block_means, with_gaps
from shared.facts import ACTION_COUNT, SHORT_NAMES

FULL = 500
"""Highest fitness of an episode (A37)."""
LONGEST_LINE = 3
"""Windows without a value that a line still crosses; a stage without training is a gap."""
ZOOM = 0.06
"""Part of all episodes on each side of the best point that the lower plot shows."""


def curve_of(run: RunFolder, column: str) -> Curve:
    """Means of a column over the run's window of episodes."""
    return block_means(run.episodes.numbers("episode"), run.episodes.numbers(column), run.window)


def band_of(experiment: Experiment, column: str) -> Band:
    """All seeds of an experiment."""
    band = band_of_blocks([curve_of(run, column) for run in experiment.runs])
    return with_gaps(band, LONGEST_LINE * experiment.runs[0].window)


@style.styled
def fitness(experiment: Experiment) -> Figure:
    """Fitness in two plots, as in the thesis: everything, and around the best episodes."""
    figure = style.sheet(4.6)
    above, below = figure.subplots(2, 1)
    colour, window = style.colours([experiment.name])[experiment.name], experiment.runs[0].window
    style.draw_band(above, band_of(experiment, "fitness"), colour, f"mean of {window} episodes")
    for run in experiment.runs:
        _full_episodes(above, run)
    style.draw_stages(above, experiment.runs[0].stages)
    _labels(above)
    _around_the_best(below, experiment, colour)
    figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _full_episodes(axes: Axes, run: RunFolder) -> None:
    episodes = run.episodes.numbers("episode")
    full = episodes[run.episodes.numbers("fitness") >= FULL]
    label = "" if GREEN in [line.get_color() for line in axes.lines[1:]] else f"{FULL} reached"
    axes.plot(full, np.full(len(full), FULL), ".", color=GREEN, markersize=3, label=label)


def _around_the_best(axes: Axes, experiment: Experiment, colour: str) -> None:
    """Single episodes and their means where one seed was best."""
    best = max(experiment.runs, key=lambda run: max(curve_of(run, "fitness")[1], default=0.0))
    places, means = curve_of(best, "fitness")
    episodes, heights = (best.episodes.numbers(name) for name in ("episode", "fitness"))
    if len(means):
        reach = max(ZOOM * (episodes[-1] - episodes[0]), 2.0 * best.window)
        middle = places[np.argmax(means)] - best.window / 2
        near = np.abs(episodes - middle) <= reach
        full = near & (heights >= FULL)
        axes.plot(episodes[near], heights[near], ".", color="#9a9a9a", markersize=2.5)
        axes.plot(episodes[full], heights[full], ".", color=GREEN, markersize=4)
        shown = np.abs(places - middle) <= reach
        axes.plot(places[shown], means[shown], color=colour, marker="o", markersize=3)
    axes.set_title(f"around the best episodes of seed {best.info.seed}; grey: single episodes")
    _labels(axes)


def _labels(axes: Axes) -> None:
    axes.set_xlabel("episode")
    axes.set_ylabel("fitness (actions)")
    axes.set_ylim(0, FULL * 1.06)


@style.styled
def loss(experiment: Experiment) -> Figure:
    """Mean loss over the window, logarithmic because it falls by orders of magnitude."""
    figure = style.sheet(2.5)
    axes = figure.subplots()
    colour, window = style.colours([experiment.name])[experiment.name], experiment.runs[0].window
    style.draw_band(axes, band_of(experiment, "loss"), colour, f"mean of {window} episodes")
    style.draw_stages(axes, experiment.runs[0].stages)
    axes.set_yscale("log")
    axes.set_xlabel("episode")
    axes.set_ylabel("loss (squared error)")
    axes.legend(loc="upper right")
    return figure


@style.styled
def compared(experiments: Sequence[Experiment], *, continued: bool = False) -> Figure:
    """Fitness of several experiments, each from its own first episode (Fig 4.12).

    continued: the last one goes on from the one before it, at a red line (Fig 4.5).
    """
    figure = style.sheet(3.1)
    axes = figure.subplots()
    named, highest = style.colours(experiment.name for experiment in experiments), 0.0
    for experiment in experiments:
        band = band_of(experiment, "fitness")
        first = experiment.runs[0].episodes.numbers("episode")[0]
        if not continued:
            band = band._replace(x=band.x - first + 1.0)
        elif experiment is experiments[-1]:
            axes.axvline(first - 0.5, color=style.SWITCH, linestyle="--", linewidth=1.0)
        style.draw_band(axes, band, named[experiment.name], experiment.name)
        highest = max(highest, float(np.nanmax(band.levels[2], initial=0.0)))
    axes.set_xlabel("episode" if continued else "episode of the run")
    axes.set_ylabel(f"fitness (actions), mean of {experiments[0].runs[0].window}")
    # Means stay far below 500 in hard experiments.
    axes.set_ylim(0, 1.1 * highest if highest else FULL)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=3)
    return figure


@style.styled
def by_action(experiment: Experiment) -> Figure:
    """Samples per action over episodes, and at the end."""
    runs = experiment.runs
    parts = {name: [_thinned(r, r.episodes.numbers(name)) for r in runs] for name in SHORT_NAMES}
    quota = [_thinned(r, r.episodes.numbers("capacity") / ACTION_COUNT) for r in runs]
    return _drawn(experiment, parts, style.ACTION_COLOURS, quota)


@style.styled
def by_world(experiment: Experiment) -> Figure:
    """Samples per corridor over episodes, and at the end."""
    runs = experiment.runs
    names = sorted({name for run in runs for name in run.samples_by_world})
    parts = {
        name: [_thinned(r, r.samples_by_world.get(name, np.zeros(len(r.episodes)))) for r in runs]
        for name in names
    }
    return _drawn(experiment, parts, style.colours(names), None)


def _thinned(run: RunFolder, values: Floats) -> Curve:
    """The state after every tenth part of a window: as much as can be seen."""
    episodes = run.episodes.numbers("episode")
    step = max(1, run.window // 10)
    kept = episodes % step == 0
    kept[-1:] = True
    return episodes[kept], values[kept]


def _drawn(
    experiment: Experiment,
    parts: Mapping[str, list[Curve]],
    colour_of: Mapping[str, str],
    quota: list[Curve] | None,
) -> Figure:
    figure = style.sheet(2.8)
    over, end = figure.subplots(1, 2, width_ratios=(3, 1), sharey=True)
    for i, (name, curves) in enumerate(parts.items()):
        style.draw_band(over, band_of_blocks(curves), colour_of[name], name)
        last = np.array([values[-1] for _, values in curves])
        middle = float(np.median(last))
        spread = [[middle - last.min()], [last.max() - middle]]
        end.bar(i, middle, color=colour_of[name], width=0.7)
        end.errorbar(i, middle, yerr=spread, color=style.INK, capsize=3, linewidth=1.0)
    if quota is not None:
        limit = band_of_blocks(quota)
        over.plot(limit.x, limit.levels[1], ":", color=GREY, label="equal share of the capacity")
        end.axhline(limit.levels[1, -1], linestyle=":", color=GREY)
    style.draw_stages(over, experiment.runs[0].stages)
    over.set_xlabel("episode")
    over.set_ylabel("samples in the memory")
    over.set_ylim(bottom=0)
    figure.legend(*over.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    end.set_xticks(range(len(parts)), list(parts))
    end.set_title("at the end", pad=10)
    end.grid(axis="x", visible=False)
    return figure
