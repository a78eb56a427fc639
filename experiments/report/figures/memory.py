"""What the replay memory holds, by action and by corridor (Fig 4.6, 4.11, 4.15)."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from experiments.report.figures import style
from experiments.report.figures.style import GREY
from experiments.report.run_folder import Experiment, Floats, RunFolder
from experiments.report.statistics import Curve, band_of_blocks
from shared.facts import ACTION_COUNT, SHORT_NAMES


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
