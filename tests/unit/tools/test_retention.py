"""What the benchmark of retention found, from made-up results."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from experiments.report.document import Findings, Missing, Picture, Table
from experiments.report.ratios import ratios
from experiments.retention.benchmark import load_benchmark
from experiments.retention.work import Measured, Network
from shared.errors import StateError
from tools import retention

BENCHMARK = load_benchmark()


def result(entry: str, seed: int, bumps: float, **contents: float) -> Measured:
    """An entry whose network bumps so often in every corridor."""
    drive = {"bumps": bumps, "actions": 25600.0, "bumps_per_1000": bumps / 25.6}
    networks = [
        Network(
            mark=mark, number=1, drives=dict.fromkeys(BENCHMARK.worlds, drive),
            contents={"share_plus": 0.4, "share_minus": 0.6, "age": 2.0, **contents},
        )
        for mark in BENCHMARK.marks
    ]  # fmt: skip
    return Measured(
        setting="standard", entry=entry, seed=seed, networks=tuple(networks), seconds=1.0,
        commit="c", machine="m",
    )  # fmt: skip


def results(**bumps: float) -> list[Measured]:
    """Four seeds of each entry; its second half bumps a tenth more often."""
    return [
        result(name.replace("_", "-"), seed, value * (1.0 + 0.1 * (seed > 2)))
        for name, value in bumps.items()
        for seed in (1, 2, 3, 4)
    ]


def blocks(found: list[Measured], kind: type) -> list[Any]:
    section = retention.retention_section(found, BENCHMARK)
    return [block for block in section.blocks if isinstance(block, kind)]


def test_a_table_for_every_mark_and_one_with_verdicts() -> None:
    found = results(rmm=10.0, normm=100.0, reservoir=10.0, rmm_cover=30.0)
    tables = {table.name: table for table in blocks(found, Table)}
    assert set(tables) == {
        "retention-standard-minus", "retention-standard-i16c", "retention-standard-verdicts",
        "retention-standard-explored",
    }  # fmt: skip
    rows = {row[0]: row for row in tables["retention-standard-minus"].rows}
    assert list(rows) == ["normm", "reservoir", "rmm", "rmm-cover"]
    assert rows["rmm"][1] == "4"
    assert rows["rmm"][5] == "40 / 60 / 0"
    judged = {row[0]: row for row in tables["retention-standard-verdicts"].rows}
    assert judged["rmm / normm"][6] == "better"
    assert judged["rmm / reservoir"][6] == "equal"
    (explored,) = tables["retention-standard-explored"].rows
    assert (explored[0], explored[6]) == ("rmm-cover / rmm", "worse, may be inferior")


def test_the_ratio_is_that_of_the_rates_seed_by_seed() -> None:
    drives = {"a": {1: (10.0, 1000.0), 2: (21.0, 1000.0), 5: (9.0, 10.0)},
              "b": {1: (4.75, 1000.0), 2: (10.25, 1000.0), 3: (1.0, 10.0)}}  # fmt: skip
    (found,) = ratios("a", ["b"], "plus", drives)
    assert found.paired.seeds == 2
    assert found.paired.ratio == pytest.approx(math.sqrt((10.5 / 5.25) * (21.5 / 10.75)))


def test_what_goes_by_age_is_not_judged() -> None:
    found = results(rmm=10.0, normm=100.0)
    found += [result("quotas", 1, 5.0, last_resort=0.2), result("quotas", 2, 5.0, last_resort=0.1)]
    told = [sentence for block in blocks(found, Findings) for sentence in block.sentences]
    assert "quotas discards 15 % by age for want of candidates" in " ".join(told)


def test_chance_in_learning_is_told_where_two_networks_learned_from_one_memory() -> None:
    found = results(rmm=10.0, normm=100.0)
    twice = [
        each.model_copy(
            update={
                "networks": tuple(
                    again
                    for network in each.networks
                    for again in (
                        network,
                        result("rmm", 1, 21.5)
                        .networks[0]
                        .model_copy(update={"mark": network.mark, "number": 2}),
                    )
                )
            }
        )
        for each in found
        if (each.entry, each.seed) == ("rmm", 1)
    ]
    told = [s for block in blocks([*found[1:], *twice], Findings) for s in block.sentences]
    # log(22 / 10.5) between the two, over the square root of 2
    assert any("differ by a factor of 1.69 (one standard deviation, 1 memories)" in s for s in told)


def test_one_seed_is_shown_and_not_judged() -> None:
    found = [result("rmm", 1, 3.0), result("normm", 1, 5.0)]
    assert {table.name for table in blocks(found, Table)} == {
        "retention-standard-minus", "retention-standard-i16c",
    }  # fmt: skip
    assert any("fewer than two seeds" in block.why for block in blocks(found, Missing))


def test_figures_can_be_drawn() -> None:
    (picture,) = blocks(results(rmm=10.0, normm=100.0, quotas=12.0), Picture)
    assert picture.image.startswith(b"\x89PNG")


def test_kept_results_are_read_as_they_were(tmp_path: Path) -> None:
    found = results(rmm=1.0)
    path = tmp_path / retention.KEPT
    retention.keep(found, path)
    assert retention.load_measured([path]) == found
    folder = tmp_path / "measured" / "standard"
    folder.mkdir(parents=True)
    newer = result("rmm", 1, 7.0)
    (folder / "rmm-1.json").write_text(newer.model_dump_json())
    (folder / "normm-1.json").write_text(result("normm", 1, 7.0).model_dump_json())
    retention.main(tmp_path / "measured", path)
    again = retention.load_measured([path])
    assert len(again) == 5
    assert newer in again
    assert retention.kept_section(tmp_path)[0].name == "retention"
    assert retention.kept_section(tmp_path / "measured") == []


def test_damaged_results_are_refused(tmp_path: Path) -> None:
    path = tmp_path / retention.KEPT
    path.write_bytes(b"no")
    with pytest.raises(StateError, match="damaged results"):
        retention.load_measured([path])
