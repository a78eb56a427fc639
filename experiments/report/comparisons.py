"""Figures and tables of several experiments together, scale by scale.

Which experiments stand together and which are compared is told by their plans
(`experiments/plans/presentation.py`): those of one group, and the comparisons that a plan names.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

from experiments.plans.presentation import Presentation
from experiments.report import findings, tables
from experiments.report.document import Block, Findings, Missing, Picture, Section, sentences
from experiments.report.figures import drives
from experiments.report.figures.style import told_apart
from experiments.report.measures import compare
from experiments.report.named_comparisons import Company, named_comparison
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
        of_scale = [e for e in experiments if e.scale == scale]
        if len(of_scale) > 1:
            of_scale.sort(key=lambda experiment: _rank(experiment, shown))
            company = Company({e.name: e for e in of_scale}, shown, scale)
            blocks = (*_tables(company), *_frozen(company), *_named(company))
            sections.append(Section(f"comparisons-{scale}", f"Comparisons, {scale} scale", blocks))
    return sections


def _rank(experiment: Experiment, shown: Mapping[str, Presentation]) -> tuple[int, str]:
    """What is expected to bump less comes first, so that a negative difference agrees with it."""
    return (-len(shown[experiment.name].expected.fewer_bumps_than), experiment.name)


def _tables(company: Company) -> list[Block]:
    """Tables that plans have a row in, and what the memories were made of."""
    blocks: list[Block] = []
    scale, members = company.scale, company.experiments
    fitness = [e for e in members.values() if company.shown[e.name].table == "fitness"]
    if fitness:
        figures = (company.shown[e.name].figures.get("table") for e in fitness)
        blocks.append(tables.fitness(fitness, scale, next(filter(None, figures), "")))
        blocks += sentences(
            [*findings.fitness_order(fitness, company.shown), *findings.same_start(fitness)]
        )
    variants = [e for e in members.values() if company.shown[e.name].table == "first-lap"]
    if len(variants) > 1:
        blocks.append(tables.first_laps(company.references_first(variants), scale))
    memories = tables.memories(list(members.values()), scale)
    return [*blocks, memories] if len(memories.rows) > 1 else blocks


def _frozen(company: Company) -> list[Block]:
    """Frozen drives of the experiments of each group together, and their differences."""
    groups: dict[tuple[str, ...], list[Experiment]] = {}
    for name, experiment in company.experiments.items():
        worlds = sorted({stage.world for stage in experiment.first.stages})
        for group in company.shown[name].groups:
            groups.setdefault((group, *worlds), []).append(experiment)
    blocks: list[Block] = []
    for (group, *worlds), members in groups.items():
        if len(members) > 1:
            members = company.references_first(members, group)
            name = "-".join((group, *worlds))
            blocks += [
                *_curves(company, name, members),
                *_differences(company, group, name, members),
            ]
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


def _differences(
    company: Company, group: str, name: str, members: Sequence[Experiment]
) -> list[Block]:
    first_only = group in company.shown[members[0].name].reference_of
    pairs, refused = compare(members, first_only=first_only)
    blocks: list[Block] = []
    if pairs:
        caption = (
            "Difference of mean bumps per 1,000 actions of the newest frozen drives. The 95 % "
            "interval is a bootstrap over seeds and too narrow with few seeds. Filled marks: it "
            "excludes 0."
        )
        title = "Differences between experiments"
        drawn = partial(drives.differences, pairs)
        blocks.append(Picture(f"{company.scale}-differences-{name}", title, caption, drawn))
        told = [findings.difference(pair, company.expected_better(pair)) for pair in pairs]
        blocks.append(Findings((*told, *findings.same_start(members))))
    if refused:
        why = f"at least 2 seeds of each are needed, but there are: {'; '.join(refused)}"
        blocks.append(Missing("difference of bumps", why))
    return blocks


def _named(company: Company) -> list[Block]:
    """The comparisons that the plans of these experiments name."""
    return [
        block
        for name, experiment in company.experiments.items()
        for comparison in company.shown[name].comparisons
        for block in named_comparison(company, experiment, comparison)
    ]
