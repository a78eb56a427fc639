"""Runs of experiments are read from disk whole, and refused in one line where they are not."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.report.run_folder import load, read_run
from shared.errors import ConfigError, StateError
from shared.run_record import EPISODE_COLUMNS, write_csv
from tests.synthetic_runs import write_probes, write_route, write_run

NAME = "policy-roulette"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_run(tmp_path, NAME, 1)


def test_seeds_of_an_experiment_come_together_from_any_level(tmp_path: Path) -> None:
    seeds = [write_run(tmp_path, NAME, seed) for seed in (2, 1)]
    other = write_run(tmp_path, "policy-eps-greedy", 1)
    for given in ([tmp_path], [seeds[0].parent, other], [*seeds, other, tmp_path]):
        experiments = load(given)
        assert [e.full_name for e in experiments] == ["policy-eps-greedy-tenth", f"{NAME}-tenth"]
        assert [run.info.seed for run in experiments[1].runs] == [1, 2]


def test_the_window_follows_the_scale(tmp_path: Path) -> None:
    for seed, (factor, window) in enumerate([(1.0, 100), (4.0, 25), (50.0, 10)]):
        assert read_run(write_run(tmp_path, NAME, seed, factor=factor)).window == window


def test_a_torn_last_line_is_left_out(folder: Path) -> None:
    path = folder / "episodes.csv"
    path.write_text(path.read_text() + "101,learn,pl")
    assert len(read_run(folder).episodes) == 100


def test_empty_fields_are_no_numbers(tmp_path: Path) -> None:
    run = read_run(write_run(tmp_path, "plus-rmm", 1))
    filtering = np.array(run.episodes.words("stage")) == "filter"
    assert np.array_equal(np.isnan(run.episodes.numbers("loss")), filtering)


def test_samples_by_corridor_are_numbers_for_every_episode(tmp_path: Path) -> None:
    samples = read_run(write_run(tmp_path, "plus-minus", 1)).samples_by_world
    assert set(samples) == {"plus", "minus"}
    assert samples["minus"][0] == 0
    assert samples["minus"][-1] == 3000


def test_routes_and_probes_are_read(folder: Path) -> None:
    write_route(folder / "route-tour.npz", "plus", [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)])
    run = read_run(folder)
    assert list(run.probes) == ["best-plus", "learn-plus"]
    route = run.routes["tour"]
    assert route.trace.bumps.tolist() == [False, True]
    assert [event.text for event in route.events] == ["passes the window", "turns"]


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"expected the folder of a run, with run\.json"):
        load([tmp_path])


def test_the_same_seed_twice_is_refused(tmp_path: Path) -> None:
    write_run(tmp_path / "a", NAME, 1)
    write_run(tmp_path / "b", NAME, 1)
    with pytest.raises(ConfigError, match=r"the same experiment and seed as .*give only one"):
        load([tmp_path / "a", tmp_path / "b"])


def test_a_damaged_record_is_refused_by_name_of_the_field(folder: Path) -> None:
    path = folder / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"factor": 0}))
    with pytest.raises(StateError, match=r"run\.json: factor: "):
        read_run(folder)


def test_a_table_with_other_columns_is_refused(folder: Path) -> None:
    (folder / "evaluations.csv").write_text("a,b\n1,2\n")
    with pytest.raises(StateError, match=r"evaluations\.csv: expected the columns label, "):
        read_run(folder)


@pytest.mark.parametrize(
    ("name", "arrays", "message"),
    [
        ("probes-x.npz", {"images": np.zeros(3)}, "world is not a file in the archive"),
        ("route-x.npz", {"places_m": np.zeros((3, 2))}, r"route-x\.npz: not the route of a drive"),
    ],
)
def test_a_file_without_an_array_is_refused(
    folder: Path, name: str, arrays: dict[str, np.ndarray], message: str
) -> None:
    np.savez(folder / name, **arrays)
    with pytest.raises(StateError, match=message):
        read_run(folder)


def test_pictures_of_another_size_are_refused(folder: Path) -> None:
    path = folder / "probes-best-plus.npz"
    write_probes(path, "plus", np.random.default_rng(1))
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **(arrays | {"images": np.zeros((16, 40, 75), np.uint8)}))
    with pytest.raises(StateError, match=r"expected images uint8 \[n, 50, 75\]"):
        read_run(folder)


def test_a_pickled_array_is_refused(folder: Path) -> None:
    np.savez(folder / "route-bad.npz", places_m=np.array([{}], dtype=object))
    with pytest.raises(StateError, match=r"route-bad\.npz"):
        read_run(folder)


def test_the_longest_way_without_a_bump_is_the_run_s_own(tmp_path: Path) -> None:
    run = read_run(write_run(tmp_path, "plus-rmm", 1))
    best = length = 0
    for row in run.episodes.rows:
        for action in range(int(row["actions"])):
            bumped = row["bump"] == "1" and action == int(row["actions"]) - 1
            length = 0 if bumped else length + 1
            best = max(best, length)
    assert run.runs_without_bump.max() == best


def test_counts_of_a_continued_run_leave_its_predecessor_out(tmp_path: Path) -> None:
    folder = write_run(tmp_path, "policy-roulette", 1)
    rows = [dict(row) for row in read_run(folder).episodes.rows]
    own = read_run(folder)
    for row in rows:
        for column in ("total_actions", "train_steps", "longest_run_actions"):
            row[column] = str(int(row[column]) + 100_000)
    write_csv(folder / "episodes.csv", EPISODE_COLUMNS, rows)
    continued = read_run(folder)
    assert (continued.actions, continued.train_steps) == (own.actions, own.train_steps)
    assert continued.train_steps == int(rows[-1]["train_steps"]) - 100_000


def test_a_run_without_episodes_counts_nothing_of_its_predecessor(tmp_path: Path) -> None:
    """A test drive of trained weights neither learned nor drove its predecessor's actions."""
    for after, actions, train_steps in (("i16c", 0, 0), ("", 900, 30)):
        folder = write_run(
            tmp_path / after, "i16c-test", 1, after=after, actions=900, train_steps=30
        )
        write_csv(folder / "episodes.csv", EPISODE_COLUMNS, [])
        run = read_run(folder)
        assert (run.actions, run.train_steps) == (actions, train_steps)
        assert np.isnan(run.one_action_share)


def test_the_share_of_episodes_of_one_action_is_counted(folder: Path) -> None:
    """E11."""
    rows = [dict(row) | {"actions": "2"} for row in read_run(folder).episodes.rows]
    for row in rows[:25]:
        row["actions"] = "1"
    write_csv(folder / "episodes.csv", EPISODE_COLUMNS, rows)
    assert read_run(folder).one_action_share == 0.25


def test_a_stage_that_goes_on_ends_at_the_newest_episode(folder: Path) -> None:
    path = folder / "run.json"
    info = json.loads(path.read_text())
    del info["stages"][0]["last_episode"]
    path.write_text(json.dumps(info))
    assert read_run(folder).stages[0].last_episode == 100
