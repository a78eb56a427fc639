"""The section of one experiment: its figures and tables, and sentences about them."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from experiments.drives import routes
from experiments.plans.presentation import Presentation
from experiments.report.document import Block, Findings, Missing, Picture, Section, Table, table
from experiments.report.figures import drives, probes, progress
from experiments.report.measures import (
    MEASURED,
    evaluated,
    longest_run,
    max_mean_fitness,
    number,
    of_seeds,
    spread,
)
from experiments.report.run_folder import WINDOW, Experiment, RunFolder
from services.robot_driver.simulated.world import World, WorldError, load_world
from shared.errors import StateError

PROBES_SHOWN = 12
MUCH_CIRCLING = 0.2
FIGURES = {
    "bumps_per_1000": "bumps per 1,000",
    "bumps_per_100m": "bumps per 100 m",
    "mean_run": "mean actions without a bump",
    "laps_left_per_1000": "laps left per 1,000",
    "laps_right_per_1000": "laps right per 1,000",
    "distance": "distance",
    "coverage": "coverage",
    "circling": "circling",
}
"""Columns of `evaluations.csv` and what the table calls them."""
REFERENCES = {"random": "random actions", "planner": "planner that knows the map"}


def section_of(experiment: Experiment, shown: Presentation) -> Section:
    """Figures, tables and sentences of one experiment."""
    this = _Shown(experiment, shown)
    blocks = (
        _completeness(experiment),
        _beside_thesis(experiment),
        *_progress(this),
        *_memory(this),
        *_evaluations(this),
        *_probes(this),
        *([tours(experiment)] if any(run.tours for run in experiment.runs) else []),
        *_routes(this),
    )
    title = f"{experiment.first.title} ({experiment.full_name})"
    return Section(experiment.full_name, title, blocks)


class _Shown(NamedTuple):
    """An experiment, and how its plan shows it."""

    experiment: Experiment
    plan: Presentation

    def picture(self, kind: str, title: str, caption: str, draw: Callable[[], Figure]) -> Picture:
        """A picture of a kind; its title names the figure of the thesis that shows the same."""
        theirs = self.plan.figures.get(kind)
        name = f"{self.experiment.full_name}-{kind}"
        return Picture(name, f"{title} ({theirs})" if theirs else title, caption, draw)

    @property
    def seeds(self) -> str:
        """What a caption says of the seeds."""
        count = len(self.experiment.runs)
        return "One seed." if count == 1 else f"{count} seeds: median, lowest to highest."

    @property
    def stages(self) -> str:
        """What the numbers above a figure mean."""
        stages = self.experiment.runs[0].stages
        told = (
            f"{i} {stage.name} ({stage.world}, {stage.first_episode} to {stage.last_episode})"
            for i, stage in enumerate(stages, start=1)
        )
        return f"Stages, with their episodes: {'; '.join(told)}." if len(stages) > 1 else ""


def _completeness(experiment: Experiment) -> Findings:
    """Which seeds there are, and which of them are not complete."""
    return Findings(
        (
            f"Seeds: {', '.join(str(run.info.seed) for run in experiment.runs)}.",
            *(
                f"Seed {r.info.seed} is not complete: {number(len(r.episodes))} episodes so far."
                for r in experiment.runs
                if not r.info.complete
            ),
        )
    )


def _beside_thesis(experiment: Experiment) -> Block:
    first, thesis = experiment.first, experiment.first.thesis
    if not thesis:
        return Missing("the thesis's numbers", "the thesis gives none for this experiment")
    rows = []
    for name, value in thesis.items():
        measure = MEASURED.get(name)
        if measure is None or not isinstance(value, int | float):
            rows.append((name.replace("_", " "), str(value), "-", "not measured"))
            continue
        scaled = number(value / first.factor if measure.grows else value)
        rows.append((measure.text, number(value), scaled, spread(of_seeds(experiment, measure.of))))
    header = ("", "thesis", f"thesis at this scale (1/{first.factor:g})", "ours")
    title = "Beside the thesis, whose numbers are those of single runs: shapes count, not digits"
    return Table(f"{experiment.full_name}-thesis", title, header, tuple(rows))


def _progress(this: _Shown) -> list[Block]:
    experiment, window = this.experiment, this.experiment.runs[0].window
    if all(len(run.episodes) < window for run in experiment.runs):
        why = f"every seed has fewer than {window} episodes"
        return [Missing("fitness and loss over episodes", why)]
    about = f"Fitness, averaged over {window} episodes; green: episodes that reached 500."
    if window != WINDOW:
        about += f" The thesis averages {WINDOW} episodes."
    drawn = partial(progress.fitness, experiment)
    blocks: list[Block] = [
        this.picture("fitness", "Fitness", f"{about} {this.seeds} {this.stages}", drawn),
        Findings(tuple(_fitness_told(experiment, window))),
    ]
    if not any(len(progress.curve_of(run, "loss")[0]) for run in experiment.runs):
        return [*blocks, Missing("loss over episodes", "nothing was trained")]
    caption = f"Loss, averaged over {window} episodes. {this.seeds} {this.stages}"
    return [*blocks, this.picture("loss", "Loss", caption, partial(progress.loss, experiment))]


def _fitness_told(experiment: Experiment, window: int) -> list[str]:
    """The highest point of the curve, beside that of the thesis where it gives one."""
    values = of_seeds(experiment, max_mean_fitness)
    if not len(values):
        return ["Too few episodes for a point of the fitness curve."]
    theirs = experiment.first.thesis.get("fitness")
    beside = "" if theirs is None else f"; thesis: {theirs}"
    longest = spread(of_seeds(experiment, longest_run))
    return [
        f"The highest mean fitness over {window} episodes was {spread(values)}{beside}.",
        f"The longest way without a bump had {longest} actions.",
    ]


def _memory(this: _Shown) -> list[Block]:
    runs = this.experiment.runs
    if not all(len(run.episodes) for run in runs):
        return [Missing("samples in the memory", "a seed has no episodes yet")]
    caption = f"Samples in the replay memory by action. {this.seeds}"
    drawn = partial(progress.by_action, this.experiment)
    blocks: list[Block] = [this.picture("memory", "Memory by action", caption, drawn)]
    if any(len(run.samples_by_world) > 1 for run in runs):
        caption = f"Samples in the replay memory by corridor. {this.seeds}"
        drawn = partial(progress.by_world, this.experiment)
        blocks.append(this.picture("worlds", "Memory by corridor", caption, drawn))
    elif theirs := this.plan.figures.get("worlds"):
        blocks.append(Missing(f"memory by corridor ({theirs})", "samples of one corridor only"))
    return blocks


def _evaluations(this: _Shown) -> list[Block]:
    experiment, blocks = this.experiment, list[Block]()
    for world in experiment.worlds:
        caption = (
            f"Drives of the frozen network in {world}. {this.seeds} Thin lines are single seeds. "
            "Horizontal lines are random actions and the planner that knows the map."
        )
        drawn = partial(drives.curves, [experiment], world)
        title = f"Frozen evaluation in {world}"
        blocks.append(this.picture(f"evaluation-{world}", title, caption, drawn))
        blocks.append(Findings(tuple(_evaluation_told(experiment, world))))
        blocks.append(frozen(experiment, world))
    why = "there are none in evaluations.csv"
    return blocks or [Missing("drives of the frozen network", why)]


def _evaluation_told(experiment: Experiment, world: str) -> list[str]:
    """The newest drive of the frozen network beside floor and ceiling, and much circling."""

    def of(column: str) -> str:
        return spread(of_seeds(experiment, evaluated(column, world)))

    told = (
        f"In {world} the frozen network had {of('bumps_per_1000')} bumps and {of('laps')} laps per "
        f"1,000 actions. On average it was {of('distance')} of the farthest possible from where it "
        f"was 50 actions ago. It visited {of('coverage')} of the corridor."
    )
    for driver, name in (("random", "Random actions"), ("planner", "The planner")):
        other = of_seeds(experiment, evaluated("bumps_per_1000", world, driver))
        if len(other):
            told += f" {name} had {number(float(np.median(other)))} bumps."
    circling = of_seeds(experiment, evaluated("circling", world))
    much = int(np.sum(circling > MUCH_CIRCLING))
    if not much:
        return [told]
    return [
        told,
        f"Mind the circling in {world}: the robot circles {spread(100 * circling)} % of the time, "
        f"and {much} of {len(circling)} seeds circle more than {100 * MUCH_CIRCLING:.0f} % of it. "
        "Few bumps or a high fitness do not mean that these seeds drive well.",
    ]


def frozen(experiment: Experiment, world: str) -> Table:
    """The newest drives of the frozen network by seed; the last rows: random actions, planner."""

    def figures(run: RunFolder, driver: str) -> tuple[str, ...]:
        return tuple(number(evaluated(column, world, driver)(run)) for column in FIGURES)

    timed = any(run.info.first_lap for run in experiment.runs)
    header, rows = ("first lap after s", "after actions") if timed else (), []
    for run in experiment.runs:
        lap = run.info.first_lap
        told = (number(lap["seconds"]), f"{lap['actions']:,.0f}") if lap else ("not yet",) * 2
        rows.append((f"seed {run.info.seed}", *told[: len(header)], *figures(run, "network")))
    for driver, shown in REFERENCES.items():
        drove = [run for run in experiment.runs if len(run.evaluations.where(driver=driver))]
        if drove:
            rows.append((shown, *("-" for _ in header), *figures(drove[-1], driver)))
    title = f"Frozen in {world}, newest drives of every seed"
    name = f"{experiment.full_name}-frozen-{world}"
    return Table(name, title, ("", *header, *FIGURES.values()), tuple(rows))


def _probes(this: _Shown) -> list[Block]:
    """What the best and the last weights predict, one figure per corridor."""
    runs = this.experiment.runs
    blocks: list[Block] = []
    for world in sorted({entry.world for run in runs for entry in run.probes.values()}):
        for weights, choose in (("best", probes.best), ("last", probes.last)):
            kind = f"probes-{weights}-{world}"
            if choice := choose(this.experiment, world):
                entry = choice.probes
                drawn = partial(probes.predictions, entry, {"reward": entry.values}, PROBES_SHOWN)
                caption = (
                    f"A fixed set of images of {world}, and the rewards predicted for "
                    f"{', '.join(probes.SHOWN)}, from −1 to 1, by seed {choice.seed}: "
                    f"{choice.weights}."
                )
                title = f"Predicted rewards in {world}, {weights} weights"
                blocks.append(this.picture(kind, title, caption, drawn))
            elif theirs := this.plan.figures.get(kind):
                blocks.append(Missing(f"predicted rewards ({theirs})", f"there is no {kind} file"))
    return blocks or [Missing("predicted rewards", "there are no files of probes")]


def tours(experiment: Experiment) -> Table:
    """Every test drive of every seed (A45)."""
    drove = [(run, *each) for run in experiment.runs for each in enumerate(run.tours)]
    title = "Test drives with turns on the spot (A45)"
    return table(f"{experiment.full_name}-tours", title, drove, {
        "seed": lambda drive: str(drive[0].info.seed),
        "drive": lambda drive: f"tour-{drive[1]}",
        "full and without a bump": lambda drive: "yes" if drive[2].passed else "no",
        "actions driven": lambda drive: f"{drive[2].driven:,}",
        "turns on the spot": lambda drive: f"{drive[2].turned:,}",
        "bumps": lambda drive: str(drive[2].bumps),
        "of the route": lambda drive: f"{100 * drive[2].route_share:.0f} %",
        "bridges": lambda drive: ", ".join(drive[2].bridges) or "-",
        "past the box": lambda drive: "yes" if drive[2].box_dropped else "no",
    })  # fmt: skip


def _routes(this: _Shown) -> list[Block]:
    theirs = this.plan.figures.get("route")
    blocks: list[Block] = []
    for run in this.experiment.runs:
        for label, (trace, events) in run.routes.items():
            bumps = int(trace.bumps.sum())
            told = "; ".join(f"{e.number} (action {e.action}) {e.text}" for e in events)
            caption = (
                f"Drive {label} of seed {run.info.seed} in {trace.world}: {len(trace.bumps)} "
                f"actions, {bumps} bump{'' if bumps == 1 else 's'}."
            ) + (f" Numbers: {told}." if told else "")
            title = f"Route in {trace.world}" + (f" ({theirs})" if theirs else "")
            world = _world(trace.world, run.folder)
            drawn = partial(routes.figure, world, [trace], title, events)
            name = f"{this.experiment.full_name}-route-{label}-{run.info.seed}"
            blocks.append(Picture(name, title, caption, drawn))
    if not blocks and theirs:
        return [Missing(f"route ({theirs})", "there is no route file")]
    return blocks


def _world(name: str, folder: Path) -> World:
    try:
        return load_world(name)
    except WorldError as error:
        raise StateError(f"{folder}: a route is in a world that does not exist: {error}") from error
