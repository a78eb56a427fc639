"""Runs of plans: stages, chains, records; stopped and continued, they are what they were to be."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from experiments.drives.tour import drive_tour
from experiments.plans.plan import Plan, read_plan
from experiments.records import EVALUATION_COLUMNS, WALL_TIME
from experiments.runs.run import Run
from experiments.runs.schedule import Job, _distinct, chain, shares_of
from experiments.runs.totals import Progress
from services.commander import frozen
from shared import run_record
from shared.errors import ConfigError, StateError

pytestmark = pytest.mark.timeout(300)

TEXT = """
title = "t"
source = "s"
{after}
[config.network]
filters = 4
[config.memory]
capacity = 60
strategy = "normm"
{fill}
[config.learning]
batch_size = 16
[config.robot]
world = "{first}"
[config.numerics] # measured ones may differ between folders that share nothing
actor = {{ engine = "torch", precision = "float32" }}
replay = {{ device = "cpu", engine = "torch", threads = 1, precision = "float32" }}
learner = {{ device = "cpu", threads = 1, precision = "float32" }}
[[stages]]
name = "a"
until = 3
[[stages]]
name = "b"
until = 7
[stages.config.memory]
capacity = 150
fill = "{second_fill}"
strategy = "rmm"
threshold_percent = 2
[stages.config.robot]
world = "{second}"
[[stages.changes]]
kind = "place"
at = 5
[stages.changes.box]
name = "box"
x_m = -3.8
y_m = 0.9
length_m = 0.2
width_m = 0.2
height_m = 1.0
rgb = [200, 0, 0]
[evaluation]
every_actions = 60
every_starts = 1
every_length = 50
starts = 1
actions = 50
lap_every_actions = {laps}
"""


def plan(name: str, **parts: str) -> Plan:
    given = {"after": "", "fill": "", "second_fill": "policy", "first": "plus", "second": "plus"}
    given["laps"] = "300"
    return read_plan(name, TEXT.format(**{**given, **parts}))


FIRST = plan("one")
GROWING = plan(
    "growing",
    fill="capacity_max = 400\ncapacity_step = 100\nrecompute_below = 999\nraise_at_most = 999",
    laps="0",
)
COUNTING = read_plan(
    "counting",
    TEXT.format(
        after='counted_in = "actions"',
        fill="equalise_every_actions = 25",
        second_fill="none",
        first="plus",
        second="plus",
        laps="0",
    )
    .replace("batch_size = 16", "batch_size = 16\nfit_every_actions = 35\nfit_epochs = 1")
    .replace("until = 3\n", "until = 40\n")
    .replace("until = 7\n", "until = 130\n")
    .replace("at = 5\n", "at = 60\n"),
)
TEST_DRIVE = read_plan(
    "drive",
    """
    title = "t"
    source = "s"
    after = "one"
    tours = 1
    [config]
    network = { filters = 4 }
    learning = { batch_size = 16 }
    robot = { world = "i16c" }
    """,
)
SECOND = plan("two", after='after = "one"', first="minus", fill='fill = "none"', second_fill="none")


def run(
    a_plan: Plan,
    folder: Path,
    before: Path | None = None,
    turns: int = 10**9,
    episodes: int = 10**9,
) -> bool:
    """Run so many turns or episodes, or to the end; whether it came to it."""
    done: list[Progress] = []
    one = Run(a_plan, "full", 1, folder, before, "command")
    try:
        return one.go(done.append, lambda: len(done) >= turns or done[-1].done >= episodes)
    finally:
        one.close()


def tables(folder: Path) -> dict[str, list[dict[str, str]]]:
    """All tables without the wall time."""
    found = {
        "episodes": run_record.read_csv(folder / "episodes.csv", run_record.EPISODE_COLUMNS),
        "evaluations": run_record.read_csv(folder / "evaluations.csv", EVALUATION_COLUMNS),
    }
    for rows in found.values():
        for row in rows:
            del row[WALL_TIME]
    return found


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A chain of two runs in one go."""
    base = tmp_path_factory.mktemp("finished")
    assert run(FIRST, base / "x" / "one")
    assert run(SECOND, base / "x" / "two", base / "x" / "one")
    return base / "x"


def with_references(finished: Path, folder: Path) -> Path:
    """A folder with the drives of chance and planner, which take longest and never change."""
    shutil.copytree(finished.parent / "references", folder / "references")
    return folder


def test_a_run_that_was_stopped_goes_on_as_if_it_had_not_been(
    finished: Path, tmp_path: Path
) -> None:
    """A46, and equal seeds give equal figures in every column but the wall time."""
    with_references(finished, tmp_path)
    one, two = tmp_path / "y" / "one", tmp_path / "y" / "two"
    assert not run(FIRST, one, turns=2)  # while the memory is being filled
    assert not run(FIRST, one, turns=6)
    assert run(FIRST, one)
    assert not run(SECOND, two, one, turns=5)  # just after the worlds changed
    assert run(SECOND, two, one)
    for name, folder in (("one", one), ("two", two)):
        assert tables(folder) == tables(finished / name)
        for weights in ("weights.safetensors", "best.safetensors"):
            assert (folder / weights).read_bytes() == (finished / name / weights).read_bytes()


def test_a_memory_that_has_grown_is_as_large_after_a_stop(finished: Path, tmp_path: Path) -> None:
    """A44: the configured capacity counts as its stage begins, not as the run goes on."""
    with_references(finished, tmp_path)
    whole, parted = tmp_path / "whole" / "growing", tmp_path / "parted" / "growing"
    assert run(GROWING, whole)
    for episodes in (4, 5, 6):
        assert not run(GROWING, parted, episodes=episodes)
    assert run(GROWING, parted)
    assert tables(parted) == tables(whole)
    capacities = [int(row["capacity"]) for row in tables(whole)["episodes"]]
    assert capacities == [60] * 3 + [250] * 4


def test_a_plan_that_counts_actions_does_all_by_them(finished: Path, tmp_path: Path) -> None:
    """E39: stages, fitting phases, equalisation and changes, however long episodes are."""
    with_references(finished, tmp_path)
    whole, parted = tmp_path / "whole" / "counting", tmp_path / "parted" / "counting"
    assert run(COUNTING, whole)
    assert not run(COUNTING, parted, turns=4)
    assert not run(COUNTING, parted, turns=3)
    assert run(COUNTING, parted)
    rows = tables(whole)["episodes"]
    assert tables(parted)["episodes"] == rows
    totals = [int(row["total_actions"]) for row in rows]
    ends = {name: max(t for t, row in zip(totals, rows, strict=True) if row["stage"] == name)
            for name in ("a", "b")}  # fmt: skip
    lengths = {int(row["episode"]): int(row["actions"]) for row in rows}
    last = {row["stage"]: lengths[int(row["episode"])] for row in rows}
    for name, until in (("a", 40), ("b", 130)):
        assert until <= ends[name] < until + last[name]
    before = [0, *totals[:-1]]
    for every, column in ((35, "fitting"), (25, "equalised")):
        due = [t // every > b // every for t, b in zip(totals, before, strict=True)]
        assert [row[column] == "1" for row in rows] == due
        assert 1 < sum(due) < len(rows)


def test_a_second_fill_ends_with_exactly_the_capacity(finished: Path) -> None:
    """E44: although discards have left 59 of 60 samples when it begins."""
    fourth = tables(finished / "one")["episodes"][3]
    assert (fourth["stage"], fourth["ended"]) == ("b", "bump")
    assert int(fourth["memory"]) + int(fourth["discarded"]) - int(fourth["actions"]) == 150


def test_stages_follow_each_other(finished: Path) -> None:
    rows = tables(finished / "one")["episodes"]
    assert [int(row["episode"]) for row in rows] == list(range(1, 8))
    assert [row["stage"] for row in rows] == ["a"] * 3 + ["b"] * 4
    assert all(int(row["memory"]) <= int(row["capacity"]) for row in rows)
    assert [int(row["capacity"]) for row in rows] == [60] * 3 + [150] * 4
    assert rows[-1]["threshold_percent"] == "2"
    record = json.loads((finished / "one" / "run.json").read_text())
    assert record["fill_actions"] >= 60 + 90  # E26: the larger memory is filled as well


def test_a_chain_goes_on_where_its_predecessor_ended(finished: Path) -> None:
    before, after = tables(finished / "one")["episodes"], tables(finished / "two")["episodes"]
    assert int(after[0]["episode"]) == int(before[-1]["episode"]) + 1
    assert int(after[0]["train_steps"]) == int(before[-1]["train_steps"]) + 1
    assert [row["world"] for row in after] == ["minus"] * 3 + ["plus"] * 4
    assert run_record.samples_by_world(after[0]["by_world"]).keys() == {"plus", "minus"}
    kept = run_record.samples_by_world(before[-1]["by_world"])["plus"]
    assert run_record.samples_by_world(after[0]["by_world"])["plus"] <= kept


def test_the_record_of_a_run_says_how_to_repeat_it(finished: Path) -> None:
    record = json.loads((finished / "two" / "run.json").read_text())
    assert (record["experiment"], record["after"], record["seed"]) == ("two", "one", 1)
    assert record["complete"] is True
    assert [stage["name"] for stage in record["stages"]] == ["a", "b"]
    assert [stage["last_episode"] for stage in record["stages"]] == [10, 14]
    with np.load(finished / "two" / "state-end" / "memory.npz") as file:
        stored = file["rows"]
    assert record["memory"] == {
        "of_fill": pytest.approx(sum(stored["episode"] == 0) / len(stored), abs=1e-4),
        "negative": pytest.approx(sum(stored["reward"] < 0) / len(stored), abs=1e-4),
        "mean_reward": pytest.approx(sum(stored["reward"]) / len(stored), abs=1e-4),
    }
    for key in ("command", "commit", "machine", "torch", "prefill"):
        assert record[key] or key == "commit"


def test_every_stage_is_evaluated_and_so_are_floor_and_ceiling(finished: Path) -> None:
    rows = tables(finished / "two")["evaluations"]
    ends = [(row["stage"], row["world"]) for row in rows if row["label"].startswith("stage")]
    assert ends == [("a", "minus"), ("b", "plus")]
    floor = {(row["driver"], row["world"]) for row in rows if row["label"] == "reference"}
    assert floor == {(d, w) for d in ("random", "planner") for w in ("minus", "plus")}


def test_a_plan_that_goes_on_keeps_its_threshold_unless_it_names_one(finished: Path) -> None:
    """E45: the default is 1 %, and the predecessor ended with 2 %."""
    assert SECOND.config["memory"].keys().isdisjoint({"threshold_percent"})
    rows = tables(finished / "two")["episodes"]
    assert [row["threshold_percent"] for row in rows] == ["2"] * 7


def test_a_first_stage_that_names_a_threshold_begins_with_it(
    finished: Path, tmp_path: Path
) -> None:
    naming = plan(
        "naming",
        after='after = "one"',
        fill='fill = "none"\nthreshold_percent = 1',
        second_fill="none",
    )
    assert not run(naming, tmp_path / "x" / "naming", finished / "one", episodes=1)
    (row,) = tables(tmp_path / "x" / "naming")["episodes"]
    assert row["threshold_percent"] == "1"


def test_a_plan_without_stages_has_the_weights_that_it_goes_on_from(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are its best ones as well: the network it was made with has learned nothing."""
    short = partial(drive_tour, most_driven=60)  # it would not get round anyway
    monkeypatch.setattr("experiments.runs.observer.drive_tour", short)
    folder = tmp_path / "x" / "drive"
    assert run(TEST_DRIVE, folder, finished / "one")
    learned = frozen.read(finished / "one" / "weights.safetensors").data
    for name in ("weights.safetensors", "best.safetensors"):
        assert frozen.read(folder / name).data == learned


def test_the_share_of_episodes_of_one_action_is_recorded(finished: Path) -> None:
    """E11: also of a run that goes on from another, of its own episodes alone."""
    for name in ("one", "two"):
        single = [row["actions"] == "1" for row in tables(finished / name)["episodes"]]
        record = json.loads((finished / name / "run.json").read_text())
        assert record["one_action_share"] == pytest.approx(sum(single) / len(single), abs=1e-5)


def test_pictures_are_looked_at_as_every_stage_ends_and_with_the_best_weights(
    finished: Path,
) -> None:
    found = {path.name for path in (finished / "two").glob("probes-*.npz")}
    assert found == {"probes-a-minus.npz", "probes-b-plus.npz", "probes-best-plus.npz"}


def test_the_longest_run_is_that_of_this_plan_alone(finished: Path) -> None:
    """A46: not that of a predecessor, whose weights are others."""
    for name in ("one", "two"):
        longest = length = 0
        for row in tables(finished / name)["episodes"]:
            length += int(row["actions"]) - int(row["bump"])
            longest = max(longest, length)
            length = length if row["ended"] == "full" else 0
        record = json.loads((finished / name / "run.json").read_text())
        assert record["longest_run"] == longest


def test_a_finished_run_is_left_alone(finished: Path) -> None:
    def files() -> dict[str, tuple[bytes, int]]:
        return {
            path.name: (path.read_bytes(), path.stat().st_mtime_ns)
            for path in (finished / "two").iterdir()
            if path.is_file()
        }

    before = files()
    assert run(SECOND, finished / "two", finished / "one")
    assert files() == before


def test_a_run_without_its_predecessor_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StateError, match="one, which has not been run to its end"):
        run(SECOND, tmp_path / "two", tmp_path / "one")


def test_a_predecessor_of_another_seed_is_refused(finished: Path, tmp_path: Path) -> None:
    with pytest.raises(StateError, match="expected a checkpoint of"):
        Run(SECOND, "full", 2, tmp_path / "x" / "two", finished / "one", "corridor experiment two")


def test_the_folder_of_another_seed_is_refused(finished: Path) -> None:
    with pytest.raises(ConfigError, match=r"run\.seed is 1 there, but 2 now"):
        Run(FIRST, "full", 2, finished / "one", None, "command")


def test_a_damaged_snapshot_is_refused(tmp_path: Path) -> None:
    assert not run(FIRST, tmp_path / "one", turns=4)
    (state,) = (tmp_path / "one").glob("state-*/state.msgpack")
    state.write_bytes(state.read_bytes()[:-5])
    with pytest.raises(StateError, match="damaged snapshot"):
        run(FIRST, tmp_path / "one")


def test_chains_begin_with_their_first_plan_and_share_runs() -> None:
    assert [each.name for each in chain("plus-minus", "tenth")] == ["plus-rmm", "plus-minus"]
    jobs = {name: Job(name, "tenth", 1, Path()) for name in ("a", "b", "c", "d")}
    a, b, c, d = jobs.values()
    assert _distinct([[a, b], [a, c], [d]]) == [[a, b, c], [d]]


@pytest.mark.parametrize(
    ("cores", "jobs", "shares"),
    [
        ([0, 1], 1, [{0, 1}]),
        ([0, 1], 2, [{0}, {1}]),
        ([3, 5, 7], 2, [{3, 7}, {5}]),
        ([4], 3, [{4}, {4}, {4}]),
    ],
)
def test_runs_side_by_side_divide_the_cores(
    cores: list[int], jobs: int, shares: list[set[int]]
) -> None:
    assert shares_of(cores, jobs) == shares
