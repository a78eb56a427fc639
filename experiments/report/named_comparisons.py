"""Comparisons that a plan names: a function per kind, from numbers to figure and sentences."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from experiments.plans.presentation import Comparison, Presentation
from experiments.report import findings
from experiments.report.document import Block, Findings, Missing, Picture, Table
from experiments.report.figures import probes, progress
from experiments.report.measures import kept, number
from experiments.report.ratios import drives_at_equal_actions, ratio_blocks, ratios, stage_drives
from experiments.report.run_folder import Experiment

PROBES_SHOWN = 6


@dataclass(frozen=True)
class Company:
    """All experiments of one scale, and how their plans show them."""

    experiments: Mapping[str, Experiment]
    """Experiments by name, in the order in which they are shown."""
    shown: Mapping[str, Presentation]
    scale: str


def named_comparison(company: Company, ours: Experiment, named: Comparison) -> list[Block]:
    """Figure, table and sentences of a comparison, or why it is left out."""
    return _KINDS[named.kind](company, ours, named)


def _titled(what: str, named: Comparison) -> str:
    return f"{what} ({named.figure})" if named.figure else what


def _absent(what: str, company: Company, names: Sequence[str]) -> list[Block]:
    """Why a figure of these experiments cannot be drawn; empty if it can."""
    absent = [name for name in names if name not in company.experiments]
    if absent:
        return [Missing(what, f"no runs of {', '.join(absent)} at this scale were given")]
    for name in names:
        for run in company.experiments[name].runs:
            if len(run.episodes) < run.window:
                return [Missing(what, f"{name}, seed {run.info.seed}, has too few episodes yet")]
    return []


def _continued(company: Company, ours: Experiment, named: Comparison) -> list[Block]:
    (earlier,) = named.others
    what = _titled(f"Fitness of {earlier}, and of {ours.name}, which continues it", named)
    if blocks := _absent(what, company, (earlier, ours.name)):
        return blocks
    before = company.experiments[earlier]
    caption = f"Mean fitness of the seeds. Red line: where {ours.name} begins."
    drawn = partial(progress.continued, before, ours)
    return [Picture(f"{ours.full_name}-continued", what, caption, drawn)]


def _fitness(company: Company, ours: Experiment, named: Comparison) -> list[Block]:
    names = (ours.name, *named.others)
    what = _titled(f"Fitness of {', '.join(names)}", named)
    if blocks := _absent(what, company, names):
        return blocks
    together = [company.experiments[name] for name in names]
    caption = (
        "Bands reach from the lowest to the highest seed. Episodes are counted from the first of "
        "each run, also if it continues another."
    )
    drawn = partial(progress.compared, together)
    picture = Picture(f"{ours.full_name}-fitness-compared", what, caption, drawn)
    return [picture, Findings((findings.highest_fitness(together),))]


def _equal_actions(company: Company, ours: Experiment, named: Comparison) -> list[Block]:
    """Bumps beside every other experiment that was run, after equally many actions of a seed."""
    found = []
    rivals = [company.experiments[name] for name in named.others if name in company.experiments]
    for theirs in rivals:
        both = drives_at_equal_actions(ours, theirs, company.experiments, named.world)
        drives = dict(zip((ours.name, theirs.name), both, strict=True))
        found += ratios(ours.name, [theirs.name], named.world, drives)
    title = f"Bumps of {ours.name} after as many actions of learning"
    return ratio_blocks(f"{ours.full_name}-equal-actions", title, found) if rivals else []


def _predictions(company: Company, ours: Experiment, named: Comparison) -> list[Block]:
    """Two networks on the same images, of the lowest seeds that have predictions."""
    (other,) = named.others
    what = _titled(f"Predicted rewards in {named.world}, {ours.name} and {other}", named)
    theirs = company.experiments.get(other)
    if theirs is None:
        return [Missing(what, f"no runs of {other} at this scale were given")]
    first = _weights(ours, named.world, named.weights)
    second = _weights(theirs, named.world, "best")
    if first is None or second is None:
        without = ours.name if first is None else other
        return [Missing(what, f"{without} has no predictions for {named.world}")]
    if not probes.same_images(first.probes, second.probes):
        return [Missing(what, "the two were asked about different images")]
    networks = {ours.name: first.probes.values, other: second.probes.values}
    caption = (
        f"Upper bars: {ours.name}, seed {first.seed}, {first.weights}; lower bars: {other}, seed "
        f"{second.seed}, {second.weights}. From −1 to 1."
    )
    if named.figure:
        caption += f" The thesis shows the {named.weights} weights above and the best below."
    drawn = partial(probes.predictions, first.probes, networks, PROBES_SHOWN)
    return [Picture(f"{ours.full_name}-predictions-{other}", what, caption, drawn)]


def _weights(experiment: Experiment, world: str, wanted: str) -> probes.Choice | None:
    """The best weights if they are wanted and were kept, else the last; the caption says which."""
    found = probes.best(experiment, world) if wanted == "best" else None
    return found or probes.last(experiment, world)


def _kept(company: Company, ours: Experiment, named: Comparison) -> list[Block]:
    """What is left of one corridor after learning others."""
    world = named.world
    title = f"Kept of {world} by {ours.name}: mean way between bumps, frozen in {world}"
    before = company.experiments.get(ours.first.after)
    starts = {run.info.seed: run for run in before.runs} if before is not None else {}
    told = (kept(run, world, starts.get(run.info.seed)) for run in ours.runs)
    found = [entry for entry in told if entry is not None]
    if not found:
        why = f"no seed drove frozen in {world} before and after it learned another corridor"
        return [Missing(title, why)]
    rows = tuple(
        (str(entry.seed), number(entry.before), number(entry.after), f"{100 * entry.share:.0f} %")
        for entry in found
    )
    header = ("seed", "before other corridors", "after them", "kept")
    table = Table(f"{ours.full_name}-kept", title, header, rows)
    return [table, Findings((findings.kept_share(found, world),))]


def _ratios(company: Company, ours: Experiment, named: Comparison) -> list[Block]:
    """Bumps at the end of every stage divided by those of each other experiment, by seed."""
    blocks: list[Block] = []
    others = [name for name in named.others if name in company.experiments]
    members = [ours, *(company.experiments[name] for name in others)]
    for stage in ours.first.stages if others else ():
        found = []
        for world in ours.worlds:
            drives = {member.name: stage_drives(member, stage.name, world) for member in members}
            found += ratios(ours.name, others, world, drives)
        title = f"Bumps of {ours.name} at the end of {stage.name}"
        blocks += ratio_blocks(f"{ours.full_name}-ratios-{stage.name}", title, found)
    return blocks


_KINDS: Mapping[str, Callable[[Company, Experiment, Comparison], list[Block]]] = {
    "continued": _continued,
    "fitness": _fitness,
    "equal-actions": _equal_actions,
    "predictions": _predictions,
    "kept": _kept,
    "ratios": _ratios,
}
