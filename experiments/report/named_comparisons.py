"""Comparisons that a plan names: a function per kind, from numbers to figure and sentences."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from experiments.plans.presentation import Comparison, Presentation
from experiments.report import findings
from experiments.report.document import Block, Findings, Missing, Picture, Table, sentences
from experiments.report.figures import probes, progress
from experiments.report.figures.drives import Compared
from experiments.report.measures import (
    at_equal_actions,
    difference_at_equal_actions,
    kept,
    number,
)
from experiments.report.ratios import ratio_table, ratios, stage_drives, told
from experiments.report.run_folder import Experiment

PROBES_SHOWN = 6


@dataclass(frozen=True)
class Company:
    """All experiments of one scale, and how their plans show them."""

    experiments: Mapping[str, Experiment]
    """Experiments by name, in the order in which they are shown."""
    shown: Mapping[str, Presentation]
    scale: str

    def references_first(
        self, members: Sequence[Experiment], group: str | None = None
    ) -> list[Experiment]:
        """The same experiments, first those that others (of a group) are compared with."""

        def later(experiment: Experiment) -> bool:
            references = self.shown[experiment.name].reference_of
            return group not in references if group else not references

        return sorted(members, key=later)

    def expected_better(self, pair: Compared) -> str | None:
        """Which of two the thesis holds for the one with fewer bumps, if it says so."""
        for better, worse in ((pair.ours, pair.theirs), (pair.theirs, pair.ours)):
            if better in self.shown and worse in self.shown[better].expected.fewer_bumps_than:
                return better
        return None


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
    picture = Picture(f"{ours.full_name}-continued", what, caption, drawn)
    told = findings.continued(before, ours, of_thesis=bool(named.figure))
    return [picture, *sentences(told)]


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
    return [picture, *sentences(findings.fitness_order(together, company.shown))]


def _equal_actions(company: Company, ours: Experiment, named: Comparison) -> list[Block]:
    """Bumps beside every other experiment that was run, after equally many actions of a seed."""
    blocks: list[Block] = []
    for other in named.others:
        theirs = company.experiments.get(other)
        if theirs is None:
            continue
        found = at_equal_actions(ours, theirs, company.experiments, named.world)
        if not found:
            continue
        rows = tuple(
            (str(e.seed), f"{e.actions:,}", number(e.ours), number(e.theirs)) for e in found
        )
        title = f"Bumps per 1,000 actions, frozen in {named.world}, after equally many actions"
        header = ("seed", "actions of learning", ours.name, other)
        name = f"{ours.full_name}-equal-actions-{other}"
        blocks.append(Table(name, f"{title}: {ours.name} and {other}", header, rows))
        if pair := difference_at_equal_actions(ours.name, other, named.world, found):
            told = findings.difference(pair, company.expected_better(pair))
            blocks.append(Findings((f"After equally many actions, {told}",)))
    return blocks


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
    networks = [
        probes.Predictions(ours.name, first.probes.values),
        probes.Predictions(other, second.probes.values),
    ]
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
    return [table, Findings(tuple(findings.kept_share(found, world)))]


def _ratios(company: Company, ours: Experiment, named: Comparison) -> list[Block]:
    """Bumps at the end of every stage divided by those of each other experiment, by seed."""
    blocks: list[Block] = []
    others = [name for name in named.others if name in company.experiments]
    members = [ours, *(company.experiments[name] for name in others)]
    for stage in ours.first.stages:
        found = [
            ratio
            for world in ours.worlds
            for ratio in ratios(
                ours.name,
                others,
                world,
                {member.name: stage_drives(member, stage.name, world) for member in members},
            )
        ]
        if found:
            title = f"Bumps at the end of {stage.name} beside {', '.join(others)}"
            name = f"{ours.full_name}-ratios-{stage.name}"
            blocks += [ratio_table(name, title, found), Findings(tuple(told(found)))]
    return blocks or [Missing(f"ratios of bumps of {ours.name}", "fewer than two common seeds")]


_KINDS: Mapping[str, Callable[[Company, Experiment, Comparison], list[Block]]] = {
    "continued": _continued,
    "fitness": _fitness,
    "equal-actions": _equal_actions,
    "predictions": _predictions,
    "kept": _kept,
    "ratios": _ratios,
}
