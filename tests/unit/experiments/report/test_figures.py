"""Figures show the numbers they claim to, where a reader expects them."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from experiments.report.figures import drives, probes, progress
from experiments.report.figures.probes import chosen
from experiments.report.figures.style import ACTION_COLOURS, PALETTE, colours, png
from experiments.report.run_folder import Experiment, load
from experiments.report.statistics import block_means
from experiments.runs.probes import Probes
from shared.facts import SHORT_NAMES
from tests.synthetic_runs import write_run


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Experiment]:
    folder = tmp_path_factory.mktemp("runs")
    for name in ("plus-rmm", "plus-minus"):
        for seed in (1, 2, 3):
            write_run(folder, name, seed)
    return {experiment.name: experiment for experiment in load([folder])}


def heights(axes: Axes) -> list[float]:
    return [patch.get_height() for patch in axes.patches]


def small_texts(figure: Figure) -> list[str]:
    texts = [text for text in figure.findobj(Text) if text.get_text() and text.get_visible()]
    return [text.get_text() for text in texts if text.get_fontsize() < 8.0]


def test_the_fitness_line_is_the_median_of_the_seeds(found: dict[str, Experiment]) -> None:
    figure = progress.fitness(found["plus-rmm"])
    line = figure.axes[0].lines[0]
    curves = [
        block_means(run.episodes.numbers("episode"), run.episodes.numbers("fitness"), 10)[1]
        for run in found["plus-rmm"].runs
    ]
    np.testing.assert_allclose(line.get_ydata(), np.median(curves, axis=0))
    assert small_texts(figure) == []


def test_green_dots_are_the_episodes_that_reached_500(found: dict[str, Experiment]) -> None:
    dots = [line for line in progress.fitness(found["plus-rmm"]).axes[0].lines if
            line.get_marker() == "."]  # fmt: skip
    shown = sum(len(np.asarray(line.get_xdata())) for line in dots)
    runs = found["plus-rmm"].runs
    assert shown == sum(int(np.sum(run.episodes.numbers("fitness") == 500)) for run in runs)


def test_the_switch_of_corridors_is_the_red_line(found: dict[str, Experiment]) -> None:
    lines = progress.fitness(found["plus-minus"]).axes[0].lines
    red = [line for line in lines if line.get_color() == "#c1272d"]
    assert [float(np.asarray(line.get_xdata())[0]) for line in red] == [850.5]


def test_a_stage_without_training_is_a_gap_in_the_loss(found: dict[str, Experiment]) -> None:
    line = progress.loss(found["plus-rmm"]).axes[0].lines[0]
    x, y = np.asarray(line.get_xdata()), np.asarray(line.get_ydata())
    gap = x[np.isnan(y)]
    assert len(gap) == 1
    assert 200 < gap[0] < 310


def test_the_compared_begin_at_their_first_episode(found: dict[str, Experiment]) -> None:
    figure = progress.compared([found["plus-rmm"], found["plus-minus"]])
    starts = [float(np.asarray(line.get_xdata())[0]) for line in figure.axes[0].lines]
    assert starts == [10.0, 10.0]


def test_bars_of_the_memory_are_the_newest_medians(found: dict[str, Experiment]) -> None:
    runs = found["plus-rmm"].runs
    expected = [
        np.median([run.episodes.numbers(name)[-1] for run in runs])
        for name in ("forward", "left", "right")
    ]
    assert heights(progress.by_action(found["plus-rmm"]).axes[1]) == expected
    by_world = progress.by_world(found["plus-minus"])
    assert heights(by_world.axes[1])[0] == 3000


def test_bars_stand_where_their_action_leads() -> None:
    values = np.array([[0.1, 0.2, 0.3], [-0.1, -0.2, -0.3]])
    images = np.zeros((2, 50, 75), np.uint8)
    shown = Probes("plus", images, values)
    figure = probes.predictions(shown, {"a": values, "b": -values}, 6)
    bars = [heights(axes) for axes in figure.axes if axes.patches]
    assert bars == [[0.2, 0.1, 0.3], [-0.2, -0.1, -0.3], [-0.2, -0.1, -0.3], [0.2, 0.1, 0.3]]
    assert small_texts(figure) == []


def test_floor_and_ceiling_are_lines_across(found: dict[str, Experiment]) -> None:
    axes = drives.curves([found["plus-rmm"]], "plus").axes[0]
    lines = {str(line.get_label()): np.asarray(line.get_ydata()) for line in axes.lines}
    across = {name: float(lines[name][0]) for name in ("random", "planner")}
    assert across == {"random": 75.0, "planner": 0.5}


def test_every_seed_has_a_line_to_its_own_end(found: dict[str, Experiment]) -> None:
    experiment = found["plus-rmm"]
    axes = drives.curves([experiment], "plus").axes[0]
    ends = [float(np.asarray(line.get_xdata())[-1]) for line in axes.lines]
    for run in experiment.runs:
        assert run.evaluated("plus").numbers("total_actions")[-1] in ends


def test_equal_figures_are_equal_bytes(found: dict[str, Experiment]) -> None:
    first, second = (png(progress.loss(found["plus-minus"])) for _ in range(2))
    assert first == second


def test_as_many_experiments_as_colours_are_told_apart() -> None:
    names = [f"plan-{number}" for number in range(len(PALETTE))]
    assert len({*colours(names).values()}) == len(names)
    assert list(ACTION_COLOURS) == list(SHORT_NAMES)


def test_images_shown_are_spread_over_the_set_in_order() -> None:
    assert chosen(3, 6) == [0, 1, 2]
    assert chosen(21, 6) == [0, 4, 8, 12, 16, 20]
