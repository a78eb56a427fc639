"""Figures and tables of several experiments together, scale by scale.

Which experiments stand together and which are compared is told by their plans
(`experiments/plans/presentation.py`): those of one group, and the comparisons that a plan names.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from experiments.plans.presentation import Comparison, Presentation
from experiments.report.document import Block, Findings, Missing, Picture, Section, Table, table
from experiments.report.figures import drives, probes, progress
from experiments.report.figures.style import PALETTE
from experiments.report.measures import (
    MISSING,
    evaluated,
    kept,
    max_mean_fitness,
    number,
    of_seeds,
    spread,
)
from experiments.report.ratios import drives_at_equal_actions, newest_drives, ratio_blocks, ratios
from experiments.report.run_folder import Experiment, RunFolder
from shared.run_record import MemoryRecord

PROBES_SHOWN = 6
Told = Callable[[Experiment], str]


class Company(NamedTuple):
    """All experiments of one scale, and how their plans show them."""

    experiments: Mapping[str, Experiment]
    """Experiments by name, in the order in which they are shown."""
    shown: Mapping[str, Presentation]
    scale: str


def compare_all(
    experiments: Sequence[Experiment], shown: Mapping[str, Presentation]
) -> list[Section]:
    """One section per scale at which at least two experiments were given."""
    sections = []
    for scale in sorted({experiment.scale for experiment in experiments}):
        of_scale = {e.name: e for e in experiments if e.scale == scale}
        if len(of_scale) > 1:
            company = Company(of_scale, shown, scale)
            blocks = (*_tables(company), *_frozen(company), *_named(company))
            sections.append(Section(f"comparisons-{scale}", f"Comparisons, {scale} scale", blocks))
    return sections


# ---------------------------------------------------------------- tables


def _tables(company: Company) -> list[Block]:
    """Tables that plans have a row in, and what the memories were made of."""
    blocks: list[Block] = []
    scale, members = company.scale, company.experiments
    fitness = [e for e in members.values() if company.shown[e.name].table == "fitness"]
    if fitness:
        figures = (company.shown[e.name].figures.get("table") for e in fitness)
        blocks.append(_fitness_table(fitness, scale, next(filter(None, figures), "")))
        blocks += _same_start(fitness)
    held = memories(list(members.values()), scale)
    return [*blocks, held] if len(held.rows) > 1 else blocks


def _fitness_table(experiments: Sequence[Experiment], scale: str, figure: str) -> Table:
    """Highest mean fitness beside that of the thesis, and frozen drives beside the fitness.

    Circling is shown because fitness takes it for driving. `figure` is the thesis's.
    """

    def frozen(column: str) -> Told:
        """A figure of the newest frozen drives in the world of the first stage."""
        return lambda e: spread(of_seeds(e, evaluated(column, e.first.stages[0].world)))

    shown = f" ({figure})" if figure else ""
    title = f"Highest mean fitness of {experiments[0].runs[0].window} episodes{shown}"
    return table(f"{scale}-fitness", title, experiments, {
        "variant": lambda e: e.first.title,
        "episodes": lambda e: number(len(e.runs[0].episodes)),
        "thesis (100 episodes)": lambda e: number(float(e.first.thesis.get("fitness", MISSING))),
        "ours": lambda e: spread(of_seeds(e, max_mean_fitness)),
        "frozen: bumps per 1,000": frozen("bumps_per_1000"),
        "frozen: distance": frozen("distance"),
        "frozen: circling": frozen("circling"),
        "seeds": lambda e: str(len(e.runs)),
    })  # fmt: skip


def memories(experiments: Sequence[Experiment], scale: str) -> Table:
    """What memories held in the end, and how many actions were taken for each of their places."""

    def told(e: Experiment) -> list[tuple[RunFolder, MemoryRecord]]:
        return [(run, run.info.memory) for run in e.runs if run.info.memory and len(run.episodes)]

    def of(figure: Callable[[RunFolder, MemoryRecord], float]) -> Told:
        return lambda e: spread(np.array([figure(*each) for each in told(e)]))

    title, shown = "What the memories held in the end", filter(told, experiments)
    return table(f"{scale}-memories", title, shown, {
        "experiment": lambda e: e.name,
        "seeds": lambda e: ", ".join(str(run.info.seed) for run, _ in told(e)),
        "actions for each place": of(lambda run, _: run.actions
                                     / run.episodes.numbers("capacity")[-1]),
        "left of the filling, %": of(lambda _, memory: 100.0 * memory.of_fill),
        "reward below 0, %": of(lambda _, memory: 100.0 * memory.negative),
        "mean reward": of(lambda _, memory: memory.mean_reward),
    })  # fmt: skip


def _same_start(experiments: Sequence[Experiment]) -> list[Block]:
    """Whether seeds that several experiments share began with equal memories (A38, A46)."""
    fills: dict[int, set[str]] = {}
    for run in (run for experiment in experiments for run in experiment.runs):
        if run.info.prefill and len(experiments) > 1:
            fills.setdefault(run.info.seed, set()).add(run.info.prefill)
    differ = [str(seed) for seed, prefills in sorted(fills.items()) if len(prefills) > 1]
    told = "The memories of each seed were equal at the beginning."
    if differ:
        told = f"In seed {', '.join(differ)} the memories were not equal at the beginning."
    return [Findings((told,))] if fills else []


# ---------------------------------------------------------------- groups


def _frozen(company: Company) -> list[Block]:
    """Frozen drives of the experiments of each group together, and their ratios of bumps."""
    groups: dict[tuple[str, ...], list[Experiment]] = {}
    for name, experiment in company.experiments.items():
        worlds = sorted({stage.world for stage in experiment.first.stages})
        for group in company.shown[name].groups:
            groups.setdefault((group, *worlds), []).append(experiment)
    blocks: list[Block] = []
    for key, members in groups.items():
        if len(members) > 1:
            members.sort(key=lambda e: key[0] not in company.shown[e.name].reference_of)
            firsts = members
            if key[0] in company.shown[members[0].name].reference_of:
                firsts = members[:1]
            blocks += _curves(company, "-".join(key), members)
            blocks += _newest(f"{company.scale}-ratios-{'-'.join(key)}", firsts, members)
            blocks += _same_start(members)
    return blocks


def _curves(company: Company, name: str, members: Sequence[Experiment]) -> list[Block]:
    if len(members) > len(PALETTE):
        what = f"frozen evaluation of {len(members)} experiments together"
        return [Missing(what, "there are too few colours to tell them apart")]
    caption = (
        "Drives of frozen networks. Bands reach from the lowest to the highest seed. Thin lines "
        "are single seeds."
    )
    return [
        Picture(
            f"{company.scale}-evaluation-{name}-in-{world}",
            f"Frozen evaluation in {world}, {', '.join(each.name for each in members)}",
            caption,
            partial(drives.curves, members, world),
        )
        for world in sorted(set.intersection(*(set(e.worlds) for e in members)))
    ]


def _newest(name: str, firsts: Sequence[Experiment], members: Sequence[Experiment]) -> list[Block]:
    """Newest bumps of the first members beside those that come after each."""
    found = []
    for place, ours in enumerate(firsts, 1):
        for world in ours.worlds:
            drove = {each.name: newest_drives(each, world) for each in members}
            found += ratios(ours.name, [each.name for each in members[place:]], world, drove)
    return ratio_blocks(name, "Bumps of the newest frozen drives, seed by seed", found)


# ---------------------------------------------------------------- comparisons that plans name


def _named(company: Company) -> list[Block]:
    """Figures, tables and sentences of the comparisons that plans name, or why one is left out."""
    return [
        block
        for name, experiment in company.experiments.items()
        for comparison in company.shown[name].comparisons
        for block in _KINDS[comparison.kind](company, experiment, comparison)
    ]


def _titled(what: str, named: Comparison) -> str:
    return f"{what} ({named.figure})" if named.figure else what


def _fitness(company: Company, ours: Experiment, named: Comparison) -> list[Block]:
    """Fitness of all, each from its first episode, or of one that goes on from another."""
    continued = named.kind == "continued"
    if continued:
        names = (*named.others, ours.name)
        what = f"Fitness of {names[0]}, and of {ours.name}, which continues it"
        caption = f"Mean fitness of the seeds. Red line: where {ours.name} begins."
    else:
        names = (ours.name, *named.others)
        what = f"Fitness of {', '.join(names)}"
        caption = (
            "Bands reach from the lowest to the highest seed. Episodes are counted from the first "
            "of each run, also if it continues another."
        )
    what = _titled(what, named)
    if absent := [name for name in names if name not in company.experiments]:
        return [Missing(what, f"no runs of {', '.join(absent)} at this scale were given")]
    together = [company.experiments[name] for name in names]
    for experiment in together:
        for run in experiment.runs:
            if len(run.episodes) < run.window:
                why = f"{experiment.name}, seed {run.info.seed}, has too few episodes yet"
                return [Missing(what, why)]
    drawn = partial(progress.compared, together, continued=continued)
    if continued:
        return [Picture(f"{ours.full_name}-continued", what, caption, drawn)]
    best = "; ".join(f"{e.name} {spread(of_seeds(e, max_mean_fitness))}" for e in together)
    picture = Picture(f"{ours.full_name}-fitness-compared", what, caption, drawn)
    return [picture, Findings((f"Highest mean fitness: {best}.",))]


def _equal_actions(company: Company, ours: Experiment, named: Comparison) -> list[Block]:
    """Bumps beside every other experiment that was run, after equally many actions of a seed."""
    found = []
    rivals = [company.experiments[name] for name in named.others if name in company.experiments]
    for theirs in rivals:
        both = drives_at_equal_actions(ours, theirs, company.experiments, named.world)
        drove = dict(zip((ours.name, theirs.name), both, strict=True))
        found += ratios(ours.name, [theirs.name], named.world, drove)
    title = f"Bumps of {ours.name} after as many actions of learning"
    return ratio_blocks(f"{ours.full_name}-equal-actions", title, found) if rivals else []


def _predictions(company: Company, ours: Experiment, named: Comparison) -> list[Block]:
    """Two networks on the same images, of the lowest seeds that have predictions.

    The best weights if they are wanted and were kept, else the last; the caption says which.
    """
    (other,) = named.others
    what = _titled(f"Predicted rewards in {named.world}, {ours.name} and {other}", named)
    theirs = company.experiments.get(other)
    if theirs is None:
        return [Missing(what, f"no runs of {other} at this scale were given")]
    best = probes.best(ours, named.world) if named.weights == "best" else None
    first = best or probes.last(ours, named.world)
    second = probes.best(theirs, named.world) or probes.last(theirs, named.world)
    if first is None or second is None:
        without = ours.name if first is None else other
        return [Missing(what, f"{without} has no predictions for {named.world}")]
    if not np.array_equal(first.probes.images, second.probes.images):
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


def _kept(company: Company, ours: Experiment, named: Comparison) -> list[Block]:
    """What is left of one corridor after learning others."""
    world = named.world
    title = f"Kept of {world} by {ours.name}: mean way between bumps, frozen in {world}"
    before = company.experiments.get(ours.first.after)
    starts = {run.info.seed: run for run in before.runs} if before is not None else {}
    found = [each for run in ours.runs if (each := kept(run, world, starts.get(run.info.seed)))]
    if not found:
        why = f"no seed drove frozen in {world} before and after it learned another corridor"
        return [Missing(title, why)]
    shares = spread(100 * np.array([entry.share for entry in found]))
    held = table(f"{ours.full_name}-kept", title, found, {
        "seed": lambda entry: str(entry.seed),
        "before other corridors": lambda entry: number(entry.before),
        "after them": lambda entry: number(entry.after),
        "kept": lambda entry: f"{100 * entry.share:.0f} %",
    })  # fmt: skip
    told = f"The network kept {shares} % of its mean way between bumps in {world}."
    return [held, Findings((told,))]


def _ratios(company: Company, ours: Experiment, named: Comparison) -> list[Block]:
    """Bumps at the end of every stage divided by those of each other experiment, by seed."""
    blocks: list[Block] = []
    others = [name for name in named.others if name in company.experiments]
    members = [ours, *(company.experiments[name] for name in others)]
    for stage in ours.first.stages if others else ():
        found = []
        label = f"stage {stage.name}"
        for world in ours.worlds:
            drove = {each.name: newest_drives(each, world, label) for each in members}
            found += ratios(ours.name, others, world, drove)
        title = f"Bumps of {ours.name} at the end of {stage.name}"
        blocks += ratio_blocks(f"{ours.full_name}-ratios-{stage.name}", title, found)
    return blocks


_KINDS: Mapping[str, Callable[[Company, Experiment, Comparison], list[Block]]] = {
    "continued": _fitness,
    "fitness": _fitness,
    "equal-actions": _equal_actions,
    "predictions": _predictions,
    "kept": _kept,
    "ratios": _ratios,
}
