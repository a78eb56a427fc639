"""The report of runs: every figure of the thesis in our form, and what it does not show.

One HTML page that needs no other file, one Markdown page per experiment and one per scale with
the comparisons. A figure whose data are not there is left out with a line saying so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

from experiments.drives import routes
from experiments.report import costs, findings, run_folder, tables
from experiments.report.comparisons import compare_all
from experiments.report.document import (
    Block,
    Findings,
    Missing,
    Picture,
    Section,
    Table,
    html,
    markdown,
    write_pictures,
)
from experiments.report.figures import drives, memory, probes, progress
from experiments.report.figures.style import stages_text
from experiments.report.measures import MEASURED, evaluated, number, of_seeds, spread
from experiments.report.run_folder import Experiment, Run
from services.robot_driver.simulated.world import World, WorldError, load_world
from shared.errors import StateError

TITLE = "Results"
PROBES_SHOWN = 12
MS_PER_H = 3.6e6
EVALUATED = ("bumps_per_1000", "laps", "distance")
"""Of the newest frozen drive, in the table of all runs."""
THESIS_FIGURES = {
    ("plus-normm", "fitness"): "Fig 4.4a",
    ("plus-normm", "loss"): "Fig 4.4b",
    ("plus-normm", "memory"): "Fig 4.6",
    ("plus-normm", "probes-best-plus"): "Fig 4.7",
    ("plus-rmm", "fitness"): "Fig 4.9a",
    ("plus-rmm", "loss"): "Fig 4.9b",
    ("plus-rmm", "memory"): "Fig 4.11",
    ("plus-minus", "fitness"): "Fig 4.14",
    ("plus-minus", "worlds"): "Fig 4.15",
    ("plus-minus", "probes-last-minus"): "Fig 4.17",
    ("i16c", "probes-last-i16c"): "Fig 4.19",
    ("i16c", "route"): "Fig 4.20",
    ("i16c-test", "route"): "Fig 4.20",
}
"""Which of our figures stands for which of the thesis."""


def write(folders: Sequence[Path], out: Path, gpu_step_ms: float | None = None) -> list[Path]:
    """Read runs and write the whole report.

    Args:
        folders: Of seeds, of experiments, or of several experiments.
        out: Where to, made if missing.
        gpu_step_ms: Measured time of a gradient step on a GPU; adds projected hours.

    Returns:
        The pages written, HTML first.

    Raises:
        ConfigError: A folder holds no run.
        StateError: A file of a run is damaged.
    """
    experiments = run_folder.load(folders)
    overview = Section("runs", "All runs", overview_blocks(experiments, gpu_step_ms))
    parts = [section_of(experiment) for experiment in experiments]
    compared = compare_all(experiments)
    sections = [overview, *compared, *parts]
    write_pictures(sections, out / "figures")
    page = out / "report.html"
    page.write_text(html(TITLE, sections), encoding="utf-8")
    written = [page]
    for section in sections:
        path = out / f"{section.name}.md"
        path.write_text(markdown([section], "figures", level=1), encoding="utf-8")
        written.append(path)
    return written


def overview_blocks(
    experiments: Sequence[Experiment], gpu_step_ms: float | None = None
) -> tuple[Block, ...]:
    """Everything that was run, and what it cost."""
    every = [run for experiment in experiments for run in experiment.runs]
    names = ("experiment", "scale", "seed")
    numbers = Table(
        "Everything run, and the newest drives of the frozen network",
        (*names, "seconds", "actions", "episodes", "of one action, %", "gradient steps",
         "frozen in", "bumps per 1,000", "laps per 1,000", "distance"),
        tuple(row for run in every for row in _number_rows(run)),
    )  # fmt: skip
    origins = Table(
        "How it was run",
        (*names, "complete", "command", "machine", "commit"),
        tuple(_origin_row(run) for run in every),
    )
    full = costs.full_scale(experiments, gpu_step_ms)
    drives = tables.test_drives(experiments)
    shown = (drives,) if drives.rows else ()
    return (numbers, _costs(experiments, gpu_step_ms), full, *shown, origins)


def _number_rows(run: Run) -> list[tuple[str, ...]]:
    """One row per corridor driven in frozen, the run's own numbers in the first only."""
    info = run.info
    own: tuple[str, ...] = (
        f"{info.seconds:,.0f}",
        f"{run.actions:,}",
        f"{len(run.episodes):,}",
        number(100.0 * run.one_action_share),
        f"{run.train_steps:,}",
    )
    worlds = dict.fromkeys(run.evaluations.where(driver="network").words("world")) or ["-"]
    rows = []
    for world in worlds:
        figures = tuple(number(evaluated(column, world)(run)) for column in EVALUATED)
        rows.append((info.experiment, info.scale, str(info.seed), *own, world, *figures))
        own = ("",) * len(own)
    return rows


def _origin_row(run: Run) -> tuple[str, ...]:
    info = run.info
    return (info.experiment, info.scale, str(info.seed), "yes" if info.complete else "no",
            f"`{info.command}`", info.machine, f"`{info.commit}`")  # fmt: skip


def _costs(experiments: Sequence[Experiment], gpu_step_ms: float | None) -> Table:
    header = ["experiment", "seeds", "actions", "gradient steps", "hours"]
    if gpu_step_ms is not None:
        header.append(f"projected hours of gradient steps on a GPU, {gpu_step_ms:g} ms each")
    rows = []
    for experiment in experiments:
        steps = sum(run.train_steps for run in experiment.runs)
        row = [
            experiment.full_name,
            str(len(experiment.runs)),
            f"{sum(run.actions for run in experiment.runs):,}",
            f"{steps:,}",
            f"{sum(run.info.seconds for run in experiment.runs) / 3600:.2f}",
        ]
        if gpu_step_ms is not None:
            row.append(f"{steps * gpu_step_ms / MS_PER_H:.2f}")
        rows.append(tuple(row))
    return Table("Cost, all seeds together", tuple(header), tuple(rows))


def section_of(experiment: Experiment) -> Section:
    """Figures, tables and sentences of one experiment."""
    blocks: list[Block] = [Findings(tuple(findings.completeness(experiment)))]
    blocks += _beside_thesis(experiment)
    blocks += _progress(experiment)
    blocks += _memory(experiment)
    blocks += _evaluations(experiment)
    blocks += _probes(experiment)
    blocks += _tours(experiment)
    blocks += _routes(experiment)
    title = f"{experiment.first.title} ({experiment.full_name})"
    return Section(experiment.full_name, title, tuple(blocks))


def _picture(
    experiment: Experiment, kind: str, title: str, caption: str, drawn: Callable[[], Figure]
) -> Picture:
    theirs = THESIS_FIGURES.get((experiment.name, kind))
    shown = f"{title} ({theirs})" if theirs else title
    return Picture(f"{experiment.full_name}-{kind}", shown, caption, drawn)


def _seeds_text(experiment: Experiment) -> str:
    count = len(experiment.runs)
    return "One seed." if count == 1 else f"{count} seeds: median, lowest to highest."


def _beside_thesis(experiment: Experiment) -> list[Block]:
    first, thesis = experiment.first, experiment.first.thesis
    if not thesis:
        return [Missing("the thesis's numbers", "the thesis tells none for this experiment")]
    rows = []
    for name, value in thesis.items():
        measure = MEASURED.get(name)
        if measure is None or not isinstance(value, int | float):
            rows.append((name.replace("_", " "), str(value), "-", "not measured"))
            continue
        scaled = number(measure.scaled(value, first))
        rows.append((measure.text, number(value), scaled, spread(of_seeds(experiment, measure.of))))
    scale = f"thesis at this scale (episodes 1/{first.factor:g}, memory 1/{first.memory_factor:g})"
    header = ("", "thesis", scale, "ours")
    title = "Beside the thesis, whose numbers are those of single runs: shapes count, not digits"
    return [Table(title, header, tuple(rows))]


def _progress(experiment: Experiment) -> list[Block]:
    window = experiment.runs[0].window
    short = [run for run in experiment.runs if len(run.episodes) < window]
    if len(short) == len(experiment.runs):
        why = f"fewer than {window} episodes in every seed"
        return [Missing("fitness and loss over episodes", why)]
    stages = stages_text(experiment.runs[0].stages)
    about = f"Fitness, averaged over {window} episodes; green: episodes that reached 500."
    if window != run_folder.WINDOW:
        about += (
            f" The thesis averages {run_folder.WINDOW}; this run is 1/{experiment.first.factor:g}."
        )
    caption = f"{about} {_seeds_text(experiment)} {stages}"
    drawn = partial(progress.fitness, experiment)
    blocks: list[Block] = [_picture(experiment, "fitness", "Fitness", caption, drawn)]
    told = [*findings.fitness(experiment), *findings.first_lap(experiment)]
    blocks.append(Findings(tuple(told)))
    if not any(len(progress.curve_of(run, "loss")[0]) for run in experiment.runs):
        return [*blocks, Missing("loss over episodes", "nothing was trained")]
    caption = f"Loss, averaged over {window} episodes. {_seeds_text(experiment)} {stages}"
    blocks.append(_picture(experiment, "loss", "Loss", caption, partial(progress.loss, experiment)))
    return [*blocks, *_sentences(findings.loss(experiment))]


def _sentences(sentences: Sequence[str]) -> list[Block]:
    return [Findings(tuple(sentences))] if sentences else []


def _memory(experiment: Experiment) -> list[Block]:
    if not all(len(run.episodes) for run in experiment.runs):
        return [Missing("samples in the memory", "a seed has no episodes yet")]
    drawn = partial(memory.by_action, experiment)
    caption = f"Samples in the replay memory by action. {_seeds_text(experiment)}"
    blocks: list[Block] = [_picture(experiment, "memory", "Memory by action", caption, drawn)]
    blocks += _sentences(findings.memory(experiment))
    several = any(len(run.samples_by_world) > 1 for run in experiment.runs)
    if several:
        caption = f"Samples in the replay memory by corridor. {_seeds_text(experiment)}"
        drawn = partial(memory.by_world, experiment)
        blocks.append(_picture(experiment, "worlds", "Memory by corridor", caption, drawn))
        blocks += _sentences(findings.worlds_in_memory(experiment))
    elif (experiment.name, "worlds") in THESIS_FIGURES:
        blocks.append(Missing("memory by corridor (Fig 4.15)", "samples of one corridor only"))
    return blocks


def _evaluations(experiment: Experiment) -> list[Block]:
    if not experiment.worlds:
        return [Missing("drives of the frozen network", "there are none in evaluations.csv")]
    blocks: list[Block] = []
    for world in experiment.worlds:
        caption = (
            f"Greedy drives of the frozen network in {world}, without learning. "
            f"{_seeds_text(experiment)} Thin lines: single seeds. Lines across: random actions and "
            "the planner that knows the map, where they drove."
        )
        title = f"Frozen evaluation in {world}"
        drawn = partial(drives.curves, [experiment], world)
        blocks.append(_picture(experiment, f"evaluation-{world}", title, caption, drawn))
        blocks += _sentences(findings.evaluation(experiment, world))
        blocks.append(tables.frozen(experiment, world))
    return blocks


def _probes(experiment: Experiment) -> list[Block]:
    """What the best and the last weights predict, one figure per corridor."""
    worlds = sorted({entry.world for run in experiment.runs for entry in run.probes})
    blocks: list[Block] = []
    for world in worlds:
        for kind, choice in (
            (f"probes-best-{world}", probes.best(experiment, world)),
            (f"probes-last-{world}", probes.last(experiment, world)),
        ):
            if choice is not None:
                blocks.append(_predictions(experiment, kind, choice))
            elif (experiment.name, kind) in THESIS_FIGURES:
                theirs = THESIS_FIGURES[experiment.name, kind]
                blocks.append(Missing(f"predicted rewards ({theirs})", f"there is no {kind} file"))
    return blocks or [Missing("predicted rewards", "there are no files of probes")]


def _predictions(experiment: Experiment, kind: str, choice: probes.Choice) -> Picture:
    entry = choice.probes
    networks = [probes.Predictions("reward", entry.values)]
    drawn = partial(probes.predictions, entry, networks, PROBES_SHOWN)
    caption = (
        f"A fixed set of images of {entry.world}, and the rewards predicted for left, forward and "
        f"right, from −1 to 1, by seed {choice.seed}: {choice.weights}."
    )
    title = f"Predicted rewards in {entry.world}, {kind.split('-')[1]} weights"
    return _picture(experiment, kind, title, caption, drawn)


def _tours(experiment: Experiment) -> list[Block]:
    told = findings.tours(experiment)
    return [tables.tours(experiment), Findings(tuple(told))] if told else []


def _routes(experiment: Experiment) -> list[Block]:
    theirs = THESIS_FIGURES.get((experiment.name, "route"))
    blocks: list[Block] = []
    for run in experiment.runs:
        for label, drive in run.routes.items():
            name = drive.trace.world
            events = "; ".join(f"{e.number} (action {e.action}) {e.text}" for e in drive.events)
            caption = f"Drive {label} of seed {run.info.seed} in {name}: "
            caption += findings.drive(drive.trace, of_thesis=theirs is not None)
            caption += f" Numbers: {events}." if events else ""
            title = f"Route in {name} ({theirs})" if theirs else f"Route in {name}"
            world = _world(name, run.folder)
            drawn = partial(routes.figure, world, [drive.trace], title, drive.events)
            kind = f"route-{label}-{run.info.seed}"
            blocks.append(_picture(experiment, kind, title, caption, drawn))
    if not blocks and theirs:
        return [Missing(f"route ({theirs})", "there is no route file")]
    return blocks


def _world(name: str, folder: Path) -> World:
    try:
        return load_world(name)
    except WorldError as error:
        raise StateError(f"{folder}: a route is in a world that is not there: {error}") from error
