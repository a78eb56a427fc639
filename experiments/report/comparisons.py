"""Figures and tables of several experiments together, scale by scale.

Which experiments stand together and which are compared is told by their plans
(`experiments/plans/presentation.py`): those of one group, and the comparisons that a plan names.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

from experiments.plans.presentation import Presentation
from experiments.report import findings, tables
from experiments.report.document import Block, Missing, Picture, Section, sentences
from experiments.report.figures import drives
from experiments.report.figures.style import told_apart
from experiments.report.named_comparisons import Company, named_comparison
from experiments.report.ratios import newest_drives, ratio_blocks, ratios
from experiments.report.run_folder import Experiment


def compare_all(
    experiments: Sequence[Experiment], shown: Mapping[str, Presentation]
) -> list[Section]:
    """One section per scale at which at least two experiments were given.

    Args:
        experiments: Of any scale.
        shown: How each of them is shown, by name.
    """
    sections = []
    for scale in sorted({experiment.scale for experiment in experiments}):
        of_scale = {e.name: e for e in experiments if e.scale == scale}
        if len(of_scale) > 1:
            company = Company(of_scale, shown, scale)
            blocks = (*_tables(company), *_frozen(company), *_named(company))
            sections.append(Section(f"comparisons-{scale}", f"Comparisons, {scale} scale", blocks))
    return sections


def _tables(company: Company) -> list[Block]:
    """Tables that plans have a row in, and what the memories were made of."""
    blocks: list[Block] = []
    scale, members = company.scale, company.experiments
    fitness = [e for e in members.values() if company.shown[e.name].table == "fitness"]
    if fitness:
        figures = (company.shown[e.name].figures.get("table") for e in fitness)
        blocks.append(tables.fitness(fitness, scale, next(filter(None, figures), "")))
        blocks += sentences(findings.same_start(fitness))
    memories = tables.memories(list(members.values()), scale)
    return [*blocks, memories] if len(memories.rows) > 1 else blocks


def _frozen(company: Company) -> list[Block]:
    """Frozen drives of the experiments of each group together, and their ratios of bumps."""
    groups: dict[tuple[str, ...], list[Experiment]] = {}
    for name, experiment in company.experiments.items():
        worlds = sorted({stage.world for stage in experiment.first.stages})
        for group in company.shown[name].groups:
            groups.setdefault((group, *worlds), []).append(experiment)
    blocks: list[Block] = []
    for (group, *worlds), members in groups.items():
        if len(members) > 1:
            members.sort(key=lambda e: group not in company.shown[e.name].reference_of)
            name = "-".join((group, *worlds))
            first_only = group in company.shown[members[0].name].reference_of
            blocks += _curves(company, name, members)
            blocks += _ratios(f"{company.scale}-ratios-{name}", members, first_only)
            blocks += sentences(findings.same_start(members))
    return blocks


def _curves(company: Company, name: str, members: Sequence[Experiment]) -> list[Block]:
    names = [experiment.name for experiment in members]
    if not told_apart(names):
        what = f"frozen evaluation of {len(names)} experiments together"
        return [Missing(what, "there are too few colours to tell them apart")]
    caption = (
        "Drives of frozen networks. Bands reach from the lowest to the highest seed. Thin lines "
        "are single seeds."
    )
    return [
        Picture(
            f"{company.scale}-evaluation-{name}-in-{world}",
            f"Frozen evaluation in {world}, {', '.join(names)}",
            caption,
            partial(drives.curves, members, world),
        )
        for world in sorted(set.intersection(*(set(e.worlds) for e in members)))
    ]


def _ratios(name: str, members: Sequence[Experiment], first_only: bool) -> list[Block]:
    """Newest bumps of each experiment, or of the first only, beside those that come after it."""
    found = []
    for place, ours in enumerate(members[:1] if first_only else members, 1):
        for world in ours.worlds:
            drove = {each.name: newest_drives(each, world) for each in members}
            others = [each.name for each in members[place:]]
            found += ratios(ours.name, others, world, drove)
    return ratio_blocks(name, "Bumps of the newest frozen drives, seed by seed", found)


def _named(company: Company) -> list[Block]:
    """The comparisons that the plans of these experiments name."""
    return [
        block
        for name, experiment in company.experiments.items()
        for comparison in company.shown[name].comparisons
        for block in named_comparison(company, experiment, comparison)
    ]
