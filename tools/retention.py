"""What the benchmark of retention found: tables, verdicts and figures (docs/comparison.md).

    python -m tools.retention [MEASURED]

adds the results in the folder MEASURED (`<out>/measured` of `corridor retention`) to those that are
kept with the code.
"""

import json
import lzma
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from pydantic import TypeAdapter, ValidationError

from experiments.report.document import Block, Missing, Section, Table
from experiments.report.measures import number
from experiments.report.ratios import Drives, common_seeds, logs, ratio_blocks, ratio_table, ratios
from experiments.retention.benchmark import Benchmark, load_benchmark
from experiments.retention.work import Measured, Network
from experiments.verdicts import Floats, interquartile_mean, log_rates, max_t
from shared.errors import StateError

KEPT = "retention.json.xz"
"""Name of the file of kept results, beside the archives of runs."""
OURS, FIRST_WORLD, BETWEEN = "rmm", "plus", "minus"
"""What is judged: RMM, by its bumps in Plus with what it kept at the end of Minus."""
LAST_RESORT = 0.05
"""An entry that discards a larger part by age is not judged (E40)."""
_RESULTS = TypeAdapter(tuple[Measured, ...])


def load_measured(paths: Iterable[Path]) -> list[Measured]:
    """Read results, of `corridor retention` or kept ones, sorted. Raises StateError if damaged."""
    found: dict[tuple[str, str, int], Measured] = {}
    for path in paths:
        try:
            data = path.read_bytes()
            if path.suffix == ".xz":
                results = _RESULTS.validate_json(lzma.decompress(data))
            else:
                results = (Measured.model_validate_json(data),)
        except (OSError, lzma.LZMAError, ValidationError) as error:
            raise StateError(f"{path}: damaged results: {error}") from error
        found |= {(each.setting, each.entry, each.seed): each for each in results}
    return [each for _, each in sorted(found.items())]


def keep(measured: Sequence[Measured], path: Path) -> None:
    """Write results as one compressed file; equal results give equal bytes."""
    text = json.dumps([each.model_dump(mode="json") for each in measured], separators=(",", ":"))
    path.write_bytes(lzma.compress(text.encode(), preset=9))


def retention_section(measured: Sequence[Measured], benchmark: Benchmark) -> Section:
    """Everything that was found, setting by setting."""
    blocks: list[Block] = []
    for setting in benchmark.settings:
        own = [each for each in measured if each.setting == setting.name]
        if not own:
            blocks.append(Missing(f"retention, {setting.name}", "nothing was measured"))
            continue
        for mark in setting.marks or benchmark.marks:
            blocks.append(_table(own, setting.name, mark, benchmark))
        blocks += _verdicts(own, setting.name, benchmark)
    return Section("retention", "What memories are worth", tuple(blocks))


def _table(measured: Sequence[Measured], setting: str, mark: str, benchmark: Benchmark) -> Table:
    """Bumps in all corridors, and what the memories held, by entry."""
    rows = []
    for entry in benchmark.entries:
        networks = [
            network for each in measured if each.entry == entry.name
            for network in each.networks if network.mark == mark
        ]  # fmt: skip
        if not networks:
            continue
        seeds = sum(each.entry == entry.name for each in measured)
        bumps = [_bumps(networks, world) for world in benchmark.worlds]
        shares = [f"{100 * _mean(networks, f'share_{w}'):.0f}" for w in benchmark.worlds]
        rows.append(
            (
                entry.name,
                str(seeds),
                *(number(interquartile_mean(values)) for values in bumps),
                " / ".join(shares),
                number(_mean(networks, "age")),
                number(_mean(networks, "nearest_bits")),
                f"{100 * _mean(networks, 'last_resort'):.1f}",
                number(_mean(networks, "discard_ms")),
                f"{_mean(networks, 'column_bytes'):.0f}",
            )
        )
    header = (
        "kept by", "seeds", *(f"bumps per 1,000 in {world}" for world in benchmark.worlds),
        f"samples of {' / '.join(benchmark.worlds)} (%)", "age (N)", "nearest other (bits)",
        "last resort (%)", "ms a discard", "bytes a sample",
    )  # fmt: skip
    title = f"What was kept at the end of {mark}, and how networks drive that learned from it"
    return Table(f"retention-{setting}-{mark}", f"{title} ({setting})", header, tuple(rows))


def _verdicts(measured: Sequence[Measured], setting: str, benchmark: Benchmark) -> list[Block]:
    """RMM beside the other primary entries, and exploratory ones beside RMM."""
    drives = {
        entry.name: drives_of(measured, entry.name, BETWEEN, FIRST_WORLD)
        for entry in benchmark.entries
    }
    primary = [e.name for e in benchmark.entries if e.primary and e.name != OURS]
    found = ratios(OURS, primary, FIRST_WORLD, drives)
    title = f"RMM beside the other primary entries in Plus, after Minus ({setting})"
    more = [*_chance(measured), *_not_judged(measured, benchmark)]
    blocks = ratio_blocks(f"retention-{setting}-verdicts", title, found, more)
    explored = [e.name for e in benchmark.entries if not e.primary]
    if table := _explored(explored, drives, setting):
        blocks.append(table)
    return blocks


def _explored(names: Sequence[str], drives: Mapping[str, Drives], setting: str) -> Table | None:
    """Exploratory entries beside RMM, with p values corrected together."""
    found = [each for name in names for each in ratios(name, [OURS], FIRST_WORLD, drives)]
    if not found:
        return None
    shared = set.intersection(*(set(common_seeds(drives[r.ours], drives[OURS])) for r in found))
    seeds = sorted(shared)
    differences = {r.ours: logs(drives[r.ours], seeds) - logs(drives[OURS], seeds) for r in found}
    p = max_t(differences) if len(seeds) > 1 else {}
    title = f"Exploratory entries beside RMM in Plus, after Minus ({setting})"
    table = ratio_table(f"retention-{setting}-explored", title, found)
    rows = tuple(
        (*row[:5], f"{p.get(each.ours, float('nan')):.3f}", *row[6:])
        for row, each in zip(table.rows, found, strict=True)
    )
    return Table(table.name, table.title, table.header, rows)


def _chance(measured: Sequence[Measured]) -> list[str]:
    """How much networks of one memory differ, by chance in learning alone."""
    gaps = []
    for each in measured:
        own = [n.drives[FIRST_WORLD] for n in each.networks if n.mark == BETWEEN]
        if len(own) > 1:
            counts = np.array([(drive["bumps"], drive["actions"]) for drive in own])
            gaps.append(float(np.std(log_rates(counts[:, 0], counts[:, 1]), ddof=1)))
    if not gaps:
        return []
    spread = float(np.sqrt(np.mean(np.square(gaps))))
    return [
        f"Networks that learn from the same memory differ by a factor of {number(np.exp(spread))} "
        f"(one standard deviation, {len(gaps)} memories), by chance in learning alone."
    ]


def _not_judged(measured: Sequence[Measured], benchmark: Benchmark) -> list[str]:
    """A sentence for each entry that discards too much by age."""
    sentences = []
    for entry in benchmark.entries:
        networks = [n for each in measured if each.entry == entry.name for n in each.networks]
        share = _mean(networks, "last_resort") if networks else 0.0
        if share > LAST_RESORT:
            sentences.append(
                f"{entry.name} discards {100 * share:.0f} % by age for want of candidates, so it "
                f"says nothing about similarity."
            )
    return sentences


def drives_of(measured: Sequence[Measured], entry: str, mark: str, world: str) -> Drives:
    """Bumps and actions by seed; of several networks of a memory, the first counts."""
    return {
        each.seed: (network.drives[world]["bumps"], network.drives[world]["actions"])
        for each in measured
        if each.entry == entry
        for network in each.networks
        if network.mark == mark and network.number == 1
    }


def _bumps(networks: Sequence[Network], world: str) -> Floats:
    return np.array([n.drives[world]["bumps_per_1000"] for n in networks if n.number == 1])


def _mean(networks: Sequence[Network], name: str) -> float:
    return float(np.mean([network.contents.get(name, 0.0) for network in networks]))


def main(
    measured: Annotated[
        Path | None, typer.Argument(metavar="[MEASURED]", help="Folder of results to keep.")
    ] = None,
    kept: Annotated[Path, typer.Option(help="File of kept results.")] = Path("docs/results") / KEPT,
) -> None:
    """Keep results of the benchmark with the code."""
    paths = [kept] if kept.exists() else []
    try:
        found = load_measured([*paths, *sorted((measured or Path()).glob("*/*.json"))])
        keep(found, kept)
    except StateError as error:
        typer.echo(f"retention: {error}", err=True)
        sys.exit(2)
    typer.echo(f"written: {kept}, {len(found)} results")


def kept_section(folder: Path) -> list[Section]:
    """The section of the results kept in a folder; empty without any. Raises StateError."""
    path = folder / KEPT
    return [retention_section(load_measured([path]), load_benchmark())] if path.exists() else []


if __name__ == "__main__":
    typer.run(main)
