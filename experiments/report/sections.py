"""The section of one experiment: its figures and tables, and sentences about them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

from experiments.drives import routes
from experiments.plans.presentation import Presentation
from experiments.report import findings, run_folder, tables
from experiments.report.document import Block, Findings, Missing, Picture, Section, Table, sentences
from experiments.report.figures import drives, memory, probes, progress
from experiments.report.figures.style import stages_text
from experiments.report.measures import MEASURED, number, of_seeds, spread
from experiments.report.run_folder import Experiment
from services.robot_driver.simulated.world import World, WorldError, load_world
from shared.errors import StateError

PROBES_SHOWN = 12


def section_of(experiment: Experiment, shown: Presentation) -> Section:
    """Figures, tables and sentences of one experiment."""
    blocks = (
        Findings(tuple(findings.completeness(experiment))),
        *_beside_thesis(experiment),
        *_progress(experiment, shown),
        *_memory(experiment, shown),
        *_evaluations(experiment, shown),
        *_probes(experiment, shown),
        *_tours(experiment),
        *_routes(experiment, shown),
    )
    title = f"{experiment.first.title} ({experiment.full_name})"
    return Section(experiment.full_name, title, blocks)


def _picture(
    experiment: Experiment,
    shown: Presentation,
    kind: str,
    title: str,
    caption: str,
    draw: Callable[[], Figure],
) -> Picture:
    """A picture of a kind; its title names the figure of the thesis that shows the same."""
    theirs = shown.figures.get(kind)
    name = f"{experiment.full_name}-{kind}"
    return Picture(name, f"{title} ({theirs})" if theirs else title, caption, draw)


def _seeds_text(experiment: Experiment) -> str:
    count = len(experiment.runs)
    return "One seed." if count == 1 else f"{count} seeds: median, lowest to highest."


def _beside_thesis(experiment: Experiment) -> list[Block]:
    first, thesis = experiment.first, experiment.first.thesis
    if not thesis:
        return [Missing("the thesis's numbers", "the thesis gives none for this experiment")]
    rows = []
    for name, value in thesis.items():
        measure = MEASURED.get(name)
        if measure is None or not isinstance(value, int | float):
            rows.append((name.replace("_", " "), str(value), "-", "not measured"))
            continue
        scaled = number(measure.scaled(value, first))
        rows.append((measure.text, number(value), scaled, spread(of_seeds(experiment, measure.of))))
    scale = f"thesis at this scale (1/{first.factor:g})"
    header = ("", "thesis", scale, "ours")
    title = "Beside the thesis, whose numbers are those of single runs: shapes count, not digits"
    return [Table(f"{experiment.full_name}-thesis", title, header, tuple(rows))]


def _progress(experiment: Experiment, shown: Presentation) -> list[Block]:
    window = experiment.runs[0].window
    if all(len(run.episodes) < window for run in experiment.runs):
        why = f"every seed has fewer than {window} episodes"
        return [Missing("fitness and loss over episodes", why)]
    picture = partial(_picture, experiment, shown)
    stages = stages_text(experiment.runs[0].stages)
    about = f"Fitness, averaged over {window} episodes; green: episodes that reached 500."
    if window != run_folder.WINDOW:
        about += f" The thesis averages {run_folder.WINDOW} episodes."
    caption = f"{about} {_seeds_text(experiment)} {stages}"
    blocks: list[Block] = [
        picture("fitness", "Fitness", caption, partial(progress.fitness, experiment)),
        Findings(tuple(findings.fitness(experiment))),
    ]
    if not any(len(progress.curve_of(run, "loss")[0]) for run in experiment.runs):
        return [*blocks, Missing("loss over episodes", "nothing was trained")]
    caption = f"Loss, averaged over {window} episodes. {_seeds_text(experiment)} {stages}"
    return [*blocks, picture("loss", "Loss", caption, partial(progress.loss, experiment))]


def _memory(experiment: Experiment, shown: Presentation) -> list[Block]:
    if not all(len(run.episodes) for run in experiment.runs):
        return [Missing("samples in the memory", "a seed has no episodes yet")]
    picture = partial(_picture, experiment, shown)
    caption = f"Samples in the replay memory by action. {_seeds_text(experiment)}"
    blocks: list[Block] = [
        picture("memory", "Memory by action", caption, partial(memory.by_action, experiment))
    ]
    if any(len(run.samples_by_world) > 1 for run in experiment.runs):
        caption = f"Samples in the replay memory by corridor. {_seeds_text(experiment)}"
        drawn = partial(memory.by_world, experiment)
        blocks.append(picture("worlds", "Memory by corridor", caption, drawn))
    elif theirs := shown.figures.get("worlds"):
        blocks.append(Missing(f"memory by corridor ({theirs})", "samples of one corridor only"))
    return blocks


def _evaluations(experiment: Experiment, shown: Presentation) -> list[Block]:
    if not experiment.worlds:
        return [Missing("drives of the frozen network", "there are none in evaluations.csv")]
    picture = partial(_picture, experiment, shown)
    blocks: list[Block] = []
    for world in experiment.worlds:
        caption = (
            f"Drives of the frozen network in {world}. "
            f"{_seeds_text(experiment)} Thin lines are single seeds. Horizontal lines are random "
            "actions and the planner that knows the map."
        )
        title = f"Frozen evaluation in {world}"
        drawn = partial(drives.curves, [experiment], world)
        blocks.append(picture(f"evaluation-{world}", title, caption, drawn))
        blocks += sentences(findings.evaluation(experiment, world))
        blocks.append(tables.frozen(experiment, world))
    return blocks


def _probes(experiment: Experiment, shown: Presentation) -> list[Block]:
    """What the best and the last weights predict, one figure per corridor."""
    worlds = sorted({entry.world for run in experiment.runs for entry in run.probes.values()})
    blocks: list[Block] = []
    for world in worlds:
        for weights, choose in (("best", probes.best), ("last", probes.last)):
            kind = f"probes-{weights}-{world}"
            choice = choose(experiment, world)
            if choice is not None:
                blocks.append(_predictions(experiment, shown, kind, choice))
            elif theirs := shown.figures.get(kind):
                blocks.append(Missing(f"predicted rewards ({theirs})", f"there is no {kind} file"))
    return blocks or [Missing("predicted rewards", "there are no files of probes")]


def _predictions(
    experiment: Experiment, shown: Presentation, kind: str, choice: probes.Choice
) -> Picture:
    entry = choice.probes
    drawn = partial(probes.predictions, entry, {"reward": entry.values}, PROBES_SHOWN)
    caption = (
        f"A fixed set of images of {entry.world}, and the rewards predicted for "
        f"{', '.join(probes.SHOWN)}, from −1 to 1, by seed {choice.seed}: {choice.weights}."
    )
    title = f"Predicted rewards in {entry.world}, {kind.split('-')[1]} weights"
    return _picture(experiment, shown, kind, title, caption, drawn)


def _tours(experiment: Experiment) -> list[Block]:
    table = tables.tours(experiment)
    return [table] if table.rows else []


def _routes(experiment: Experiment, shown: Presentation) -> list[Block]:
    theirs = shown.figures.get("route")
    blocks: list[Block] = []
    for run in experiment.runs:
        for label, drive in run.routes.items():
            name = drive.trace.world
            events = "; ".join(f"{e.number} (action {e.action}) {e.text}" for e in drive.events)
            caption = f"Drive {label} of seed {run.info.seed} in {name}: "
            caption += findings.drive(drive.trace)
            caption += f" Numbers: {events}." if events else ""
            title = f"Route in {name} ({theirs})" if theirs else f"Route in {name}"
            world = _world(name, run.folder)
            drawn = partial(routes.figure, world, [drive.trace], title, drive.events)
            picture = f"{experiment.full_name}-route-{label}-{run.info.seed}"
            blocks.append(Picture(picture, title, caption, drawn))
    if not blocks and theirs:
        return [Missing(f"route ({theirs})", "there is no route file")]
    return blocks


def _world(name: str, folder: Path) -> World:
    try:
        return load_world(name)
    except WorldError as error:
        raise StateError(f"{folder}: a route is in a world that does not exist: {error}") from error
