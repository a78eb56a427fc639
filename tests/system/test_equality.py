"""Distribution changes nothing: four processes over a real router equal the single-process loop."""

from __future__ import annotations

import csv
import random
import secrets
from pathlib import Path

import pytest
from cluster import ALL, Cluster, make_config
from comparison import Outcome, assert_equal, distributed, single_process

from services.cli import main as cli
from shared.config import Config

EPISODES = 40
pytestmark = [pytest.mark.system, pytest.mark.timeout(400)]


@pytest.fixture(scope="module")
def config() -> Config:
    """Everything that changes memory or weights happens within 40 episodes.

    Discards, growth and then a higher threshold, marks by decree, target copies, and after so many
    actions equalisation and fitting phases. What the network learns differs between processors, so
    nothing here depends on it: every search looks for more candidates than there can be, and so
    late a decree leaves marks.
    """
    memory = {
        "capacity_max": 430,
        "capacity_step": 20,
        "recompute_below": 500,
        "raise_at_most": 500,
        "mark_all_at_episode": EPISODES - 4,
        "equalise_every_actions": 130,
    }
    run, learning = {"episodes": EPISODES}, {"fit_every_actions": 210}
    return make_config("equality", run=run, memory=memory, learning=learning)


@pytest.fixture(scope="module")
def reference(config: Config) -> Outcome:
    """The single-process loop with the same seed, checked to contain what is to be compared."""
    outcome = single_process(config, EPISODES)
    assert outcome.digests[-1][0] == EPISODES
    assert (outcome.memory.rows["candidate"] & ~outcome.memory.rows["forced"]).any()
    assert outcome.memory.rows["forced"].any()
    assert outcome.memory.capacity == config.memory.capacity_max > config.memory.capacity
    assert outcome.kept["threshold_percent"] > config.memory.threshold_percent
    assert outcome.version > 10
    return outcome


def test_undisturbed_run_equals_the_single_process_loop(
    config: Config, reference: Outcome, tmp_path: Path
) -> None:
    with Cluster(config, tmp_path / "run") as cluster:
        cluster.start(*ALL)
        cluster.wait_episodes(EPISODES, 200)
        state = cluster.replay()
        cluster.stop_all()
    assert_equal(reference, distributed(config, tmp_path / "run"))
    assert state is not None
    with (tmp_path / "run" / "episodes.csv").open(newline="") as file:
        capacities = [int(row["capacity"]) for row in csv.DictReader(file)]
    assert state.capacity == capacities[-1] == reference.memory.capacity
    assert {420, 430} <= set(capacities) <= {400, 420, 430}


def test_replay_learner_and_router_killed_at_random_moments_still_end_equal(
    config: Config, reference: Outcome, tmp_path: Path
) -> None:
    seed = secrets.randbits(32)
    draw = random.Random(seed)
    print(f"kill seed {seed}")  # noqa: T201  (shown when the test fails)
    victims = ["replay", "learner", "router"]
    draw.shuffle(victims)
    moments = sorted(draw.sample(range(2, EPISODES - 2), len(victims)))
    with Cluster(config, tmp_path / "run") as cluster:
        cluster.start(*ALL)
        for victim, episode in zip(victims, moments, strict=True):
            cluster.wait_episodes(episode, 200)
            cluster.stall(draw.uniform(0.0, 0.3))
            cluster.kill(victim)
            cluster.stall(draw.uniform(0.0, 1.0))
            cluster.start(victim)
        cluster.wait_episodes(EPISODES, 200)
        cluster.stop_all()
    assert_equal(reference, distributed(config, tmp_path / "run"))


def test_clean_stops_and_resumes_still_end_equal(
    config: Config, reference: Outcome, tmp_path: Path
) -> None:
    seed = secrets.randbits(32)
    draw = random.Random(seed)
    print(f"stop seed {seed}")  # noqa: T201  (shown when the test fails)
    with Cluster(config, tmp_path / "run") as cluster:
        # So far apart that all are up again, and drive, before the second stop.
        first = draw.randrange(2, EPISODES // 2)
        for episode in (first, draw.randrange(first + 10, EPISODES - 2)):
            cluster.start(*ALL)
            cluster.wait_episodes(episode, 200)
            cluster.stall(draw.uniform(0.0, 0.3))
            cluster.stop_all()
        cluster.start(*ALL)
        cluster.wait_episodes(EPISODES, 200)
        cluster.stop_all()
    assert_equal(reference, distributed(config, tmp_path / "run"))


@pytest.mark.slow
def test_an_encrypted_run_equals_the_single_process_loop(
    config: Config, reference: Outcome, tmp_path: Path
) -> None:
    assert cli.main(["secure", "init", str(tmp_path / "secure"), "--robot", "robotino1"]) == 0
    bus = config.bus.model_copy(update={"credentials": str(tmp_path / "secure")})
    guarded = config.model_copy(update={"bus": bus})
    with Cluster(guarded, tmp_path / "run") as cluster:
        cluster.start(*ALL)
        cluster.wait_episodes(EPISODES, 200)
        cluster.stop_all()
    assert_equal(reference, distributed(guarded, tmp_path / "run"))
