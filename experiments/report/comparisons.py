"""Figures and tables of several experiments together, scale by scale."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from experiments.report import findings, tables
from experiments.report.document import Block, Findings, Missing, Picture, Section, Table
from experiments.report.figures import drives, probes, progress
from experiments.report.figures.style import told_apart
from experiments.report.measures import (
    MISSING,
    Kept,
    at_equal_actions,
    compare,
    difference_at_equal_actions,
    evaluated,
    kept,
    max_mean_fitness,
    number,
    of_seeds,
    spread,
)
from experiments.report.run_folder import Experiment

POLICY = "policy-"
"""Experiments whose name begins so are rows of the table of policies (Fig 4.2)."""
POLICY_FROZEN = ("bumps_per_1000", "distance", "circling")
"""Beside the fitness, which takes circling for driving."""
PROBES_SHOWN = 6
EXPECTED_BEST_FIRST = (
    "search-demo", "plus-rmm", "plus-rmm-nopretrain", "plus-rmm-quotas", "plus-rmm-no-equalisation",
    "plus-rmm-no-fits", "plus-normm-fit", "plus-normm-fit-alone", "plus-normm",
)  # fmt: skip
SEARCH = "search-"
"""Variants of the demo; differences are those to the demo."""
APART = (
    "plus-rmm-nopretrain", "plus-rmm-quotas", "plus-rmm-no-equalisation", "plus-rmm-no-fits",
    "plus-normm-fit-alone",
)  # fmt: skip
"""RMM from the first episode, and what is left of it without one of its parts each."""
RETURNING = ("plus-minus", "plus-minus-normm")
"""Go on from Plus to another corridor, and come back."""
EQUAL = (
    ("plus-rmm", "plus-normm"),
    ("plus-rmm", "plus-normm-fit"),
    ("plus-rmm-nopretrain", "plus-normm-fit-alone"),
    ("plus-rmm", "dqn-distance"),
)
"""Compared after equally many actions; plus-normm-fit goes on from plus-normm."""
Named = dict[str, Experiment]


def compare_all(experiments: Sequence[Experiment]) -> list[Section]:
    """One section per scale at which at least two experiments were given."""
    sections = []
    for scale in sorted({experiment.scale for experiment in experiments}):
        of_scale = [e for e in experiments if e.scale == scale]
        named = {e.name: e for e in of_scale}
        if len(named) > 1:
            blocks = (
                *_policies(named),
                *_continued(named),
                *_fitted(named),
                *_searched(named),
                *_frozen(named),
                *_memories(named),
                *_equal(named),
                *_predictions(named, "plus-rmm", "plus-normm", "4.10", of_best=True),
                *_predictions(named, "plus-minus", "plus-rmm", "4.16", of_best=False),
                *_kept(named),
            )
            sections.append(Section(f"comparisons-{scale}", f"Comparisons, {scale} scale", blocks))
    return sections


def _missing(what: str, named: Named, needed: Sequence[str]) -> list[Block]:
    absent = [name for name in needed if name not in named]
    return [Missing(what, f"no runs of {', '.join(absent)} at this scale were given")]


def _policies(named: Named) -> list[Block]:
    shown = [e for name, e in named.items() if name.startswith(POLICY)]
    if not shown:
        return []
    rows = tuple(
        (
            e.first.title,
            number(len(e.runs[0].episodes)),
            number(float(e.first.thesis.get("fitness", MISSING))),
            spread(of_seeds(e, max_mean_fitness)),
            *(spread(of_seeds(e, evaluated(name, "plus"))) for name in POLICY_FROZEN),
            str(len(e.runs)),
        )
        for e in shown
    )
    window = shown[0].runs[0].window
    title = f"Action policies (Fig 4.2): highest mean fitness of {window} episodes"
    header = (
        "policy", "episodes", "thesis (100 episodes)", "ours, median and span",
        "frozen: bumps per 1,000", "frozen: distance", "frozen: circling", "seeds",
    )  # fmt: skip
    told = [*findings.policies(shown), *findings.same_start(shown)]
    return [Table(title, header, rows), Findings(tuple(told))]


def _sentences(sentences: Sequence[str]) -> list[Block]:
    return [Findings(tuple(sentences))] if sentences else []


def _continued(named: Named) -> list[Block]:
    what = "NoRMM going on with fitting phases (Fig 4.5)"
    needed = ("plus-normm", "plus-normm-fit")
    if blocks := _absent(what, named, needed):
        return blocks
    before, after = (named[name] for name in needed)
    caption = "Fitness. Red line: where fitting phases and five mini-batches per episode begin."
    drawn = partial(progress.continued, before, after)
    picture = Picture(f"{before.scale}-fits", what, caption, drawn)
    return [picture, *_sentences(findings.continued(before, after))]


def _absent(what: str, named: Named, needed: Sequence[str]) -> list[Block]:
    """Why a figure cannot be drawn; empty if it can."""
    if not all(name in named for name in needed):
        return _missing(what, named, needed)
    for name in needed:
        for run in named[name].runs:
            if len(run.episodes) < run.window:
                return [Missing(what, f"{name}, seed {run.info.seed}: too few episodes yet")]
    return []


def _fitted(named: Named) -> list[Block]:
    what = "RMM with and without pre-training, and NoRMM with fits (Fig 4.12)"
    needed = ("plus-rmm", "plus-rmm-nopretrain", "plus-normm-fit")
    if blocks := _absent(what, named, needed):
        return blocks
    shown = [named[name] for name in needed]
    caption = (
        "Fitness; bands: lowest to highest seed. Episodes are counted from each run's first; "
        "plus-normm-fit goes on from plus-normm, the others begin anew."
    )
    picture = Picture(f"{shown[0].scale}-rmm", what, caption, partial(progress.compared, shown))
    return [picture, *_sentences(findings.fitted(shown[:2], shown[2]))]


def _searched(named: Named) -> list[Block]:
    """The variants of the demo side by side, the demo itself first."""
    shown = [e for name, e in sorted(named.items(), key=_rank) if name.startswith(SEARCH)]
    return [tables.search(shown)] if len(shown) > 1 else []


def _memories(named: Named) -> list[Block]:
    """What the memories were made of, where runs told."""
    table = tables.memories([experiment for _, experiment in sorted(named.items(), key=_rank)])
    return [table] if len(table.rows) > 1 else []


def _frozen(named: Named) -> list[Block]:
    """Frozen drives of comparable experiments together, and differences of their pairs."""
    blocks: list[Block] = []
    for group, shown in _comparable(named).items():
        blocks += _together(group, shown)
    return blocks


def _comparable(named: Named) -> dict[str, list[Experiment]]:
    """Experiments that learned the same corridors, by kind; alone ones left out."""
    groups: dict[str, list[Experiment]] = {}
    for name, experiment in sorted(named.items(), key=_rank):
        worlds = sorted({stage.world for stage in experiment.first.stages})
        for kind in _kinds(name):
            groups.setdefault("-".join([kind, *worlds]), []).append(experiment)
    return {group: shown for group, shown in groups.items() if len(shown) > 1}


def _kinds(name: str) -> list[str]:
    """The groups an experiment is shown in."""
    if name.startswith(POLICY):
        return ["policies"]
    if name.startswith(SEARCH):
        return ["search"]
    if name not in APART:
        return ["runs"]
    return ["runs", "parts"] if name == APART[0] else ["parts"]


def _rank(item: tuple[str, Experiment]) -> tuple[int, str]:
    """RMM before NoRMM, so that a negative difference means that RMM bumped less."""
    name, known = item[0], EXPECTED_BEST_FIRST
    return (known.index(name) if name in known else len(known), name)


def _together(group: str, shown: Sequence[Experiment]) -> list[Block]:
    scale = shown[0].scale
    blocks: list[Block] = []
    names = [experiment.name for experiment in shown]
    worlds = sorted(set.intersection(*(set(e.worlds) for e in shown)))
    if not told_apart(names):
        what = f"frozen evaluation of {len(names)} experiments together"
        blocks.append(Missing(what, "more than colours tell apart; each has its own figure"))
        worlds = []
    for world in worlds:
        caption = (
            "Greedy drives without learning; bands: lowest to highest seed; thin lines: single "
            "seeds."
        )
        drawn = partial(drives.curves, shown, world)
        title = f"Frozen evaluation in {world}, {', '.join(names)}"
        name = f"{scale}-evaluation-{group}-in-{world}"
        blocks.append(Picture(name, title, caption, drawn))
    one_with_others = group.startswith(("search", "parts"))
    pairs, refused = compare(shown, first_only=one_with_others)
    if pairs:
        caption = (
            "Difference of mean bumps per 1,000 actions of the newest frozen drives; bootstrap "
            "over seeds, 95 % interval, too narrow with few seeds. Filled: it excludes 0."
        )
        drawn = partial(drives.differences, pairs)
        name = f"{scale}-differences-{group}"
        blocks.append(Picture(name, "Differences between experiments", caption, drawn))
        told = [*(findings.difference(pair) for pair in pairs), *findings.same_start(shown)]
        blocks.append(Findings(tuple(told)))
    if refused:
        why = f"{'; '.join(refused)}, at least 2 each needed"
        blocks.append(Missing("difference of bumps", why))
    return blocks


def _equal(named: Named) -> list[Block]:
    """What the thesis compares, after equally many actions of every seed."""
    blocks: list[Block] = []
    for first, second in EQUAL:
        if first not in named or second not in named:
            continue
        found = at_equal_actions(named[first], named[second], named, "plus")
        if not found:
            continue
        rows = tuple(
            (str(e.seed), f"{e.actions:,}", number(e.ours), number(e.theirs)) for e in found
        )
        title = f"Bumps per 1,000 actions, frozen in plus, after equally many actions: {first}"
        header = ("seed", "actions of learning", first, second)
        blocks.append(Table(f"{title} and {second}", header, rows))
        if pair := difference_at_equal_actions(first, second, "plus", found):
            blocks.append(Findings((f"After equally many actions: {findings.difference(pair)}",)))
    return blocks


def _predictions(
    named: Named, ours: str, theirs: str, figure: str, *, of_best: bool
) -> list[Block]:
    """Two networks on the same images of Plus, the lowest seeds (Fig 4.10, 4.16).

    Args:
        named: All experiments of a scale.
        ours: The one above.
        theirs: The one below, always with its best weights if their predictions are there.
        figure: Of the thesis.
        of_best: Whether the best or the last weights of `ours` are asked for.
    """
    what = f"Predicted rewards in plus, {ours} and {theirs} (Fig {figure})"
    if not (ours in named and theirs in named):
        return _missing(what, named, (ours, theirs))
    first, second = _weights(named[ours], of_best), _weights(named[theirs], True)
    if first is None or second is None:
        return [Missing(what, f"{ours if first is None else theirs} has no probes of Plus")]
    if not probes.same_images(first.probes, second.probes):
        return [Missing(what, "the two were asked about different images")]
    networks = [
        probes.Predictions(ours, first.probes.values),
        probes.Predictions(theirs, second.probes.values),
    ]
    caption = (
        f"Upper bars: {ours}, seed {first.seed}, {first.weights}; lower bars: {theirs}, seed "
        f"{second.seed}, {second.weights}. From −1 to 1. The thesis shows "
        f"{'the best' if of_best else 'the last'} weights above and the best below."
    )
    drawn = partial(probes.predictions, first.probes, networks, PROBES_SHOWN)
    return [Picture(f"{named[ours].scale}-probes-{ours}-{theirs}", what, caption, drawn)]


def _weights(experiment: Experiment, of_best: bool) -> probes.Choice | None:
    """Best weights if asked for and looked at, else the last; the caption says which."""
    found = probes.best(experiment, "plus") if of_best else None
    return found or probes.last(experiment, "plus")


def _kept(named: Named) -> list[Block]:
    """What is left of Plus after learning Minus, with RMM and without."""
    what = "Kept of Plus: actions between bumps in frozen drives before and after Minus"
    blocks: list[Block] = []
    for name in RETURNING:
        if name in named:
            blocks += _kept_by(named, named[name], f"{what}, {name}")
    return blocks


def _kept_by(named: Named, experiment: Experiment, title: str) -> list[Block]:
    before = named.get(experiment.first.after)
    starts = {run.info.seed: run for run in before.runs} if before is not None else {}
    found: list[Kept] = []
    for run in experiment.runs:
        entry = kept(run, "plus", starts.get(run.info.seed))
        if entry is not None:
            found.append(entry)
    if not found:
        return [Missing(title, "no seed drove frozen in Plus before and after the Minus stage")]
    rows = tuple(
        (str(entry.seed), number(entry.before), number(entry.after), f"{100 * entry.share:.0f} %")
        for entry in found
    )
    header = ("seed", "before Minus", "after Minus", "kept")
    return [Table(title, header, rows), Findings(tuple(findings.kept_share(found, "Plus")))]
