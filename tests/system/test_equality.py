"""Distribution changes nothing: four processes over a real router equal the single-process loop."""

from __future__ import annotations

import random
import secrets
from pathlib import Path

import pytest
from cluster import ALL, Cluster, make_config
from comparison import Outcome, assert_equal, distributed, single_process

from shared.config import Config

EPISODES = 62
pytestmark = [pytest.mark.system, pytest.mark.timeout(400)]


@pytest.fixture(scope="module")
def config() -> Config:
    """Discard, equalisation, fitting phases and target copies all happen within 62 episodes."""
    return make_config("equality", run={"episodes": EPISODES})


@pytest.fixture(scope="module")
def reference(config: Config) -> Outcome:
    """The single-process loop with the same seed, checked to contain what is to be compared."""
    outcome = single_process(config, EPISODES)
    assert outcome.digests[-1][0] == EPISODES
    assert outcome.memory.rows["candidate"].any()
    assert outcome.version > 10
    return outcome


def test_undisturbed_run_equals_the_single_process_loop(
    config: Config, reference: Outcome, tmp_path: Path
) -> None:
    with Cluster(config, tmp_path / "run") as cluster:
        cluster.start(*ALL)
        cluster.wait_episodes(EPISODES, 200)
        cluster.stop_all()
    assert_equal(reference, distributed(config, tmp_path / "run"))


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
        for episode in sorted(draw.sample(range(2, EPISODES - 2), 2)):
            cluster.start(*ALL)
            cluster.wait_episodes(episode, 200)
            cluster.stall(draw.uniform(0.0, 0.3))
            cluster.stop_all()
        cluster.start(*ALL)
        cluster.wait_episodes(EPISODES, 200)
        cluster.stop_all()
    assert_equal(reference, distributed(config, tmp_path / "run"))
