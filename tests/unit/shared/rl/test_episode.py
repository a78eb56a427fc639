"""Episode bookkeeping and the actor against a simulation of Fig 3.2 (A9-A11, E6, E10, E11)."""

from __future__ import annotations

import math
from typing import Any

import msgpack
import numpy as np
import oracles
import pytest
from builders import LIFE, OTHER_LIFE, FakePredictor, fake_values, make_config, make_observation
from hypothesis import example, given, settings
from hypothesis import strategies as st

from services.actor.actor import Actor
from shared.config import EpisodeConfig
from shared.facts import CHOOSERS
from shared.messages import Action, Episode, Observation, RobotProgress
from shared.rl.draws import generator
from shared.rl.episode import OpenEpisode, Step
from shared.rl.policy import choose

FAST = settings(deadline=None, max_examples=60, derandomize=True)
SHORT = EpisodeConfig(max_samples=12, horizon=4)
NEXT_LIFE = "c" * 12


def make_step(sequence: int) -> Step:
    return Step(b"", 0, 0.0, 0.0, 0.0, "plus", 0.0, 1, 1, sequence, 0, sequence)


# ------------------------------------------------------------------------- OpenEpisode


@FAST
@given(st.lists(st.sampled_from(["go"] * 12 + ["bump", "interrupted"]), max_size=120))
def test_every_step_is_released_or_dropped_or_open_exactly_once(events: list[str]) -> None:
    episode, ebatch = OpenEpisode(SHORT), []
    stored: list[int] = []
    dropped: list[int] = []
    for sequence, event in enumerate(events):
        episode.add(make_step(sequence))
        ebatch.append(sequence)
        fitness = len(ebatch)
        if event == "bump":
            released, lost, ebatch = ebatch, [], []
        elif event == "interrupted":
            whole = max(len(ebatch) - SHORT.horizon, 0)
            released, lost, ebatch = ebatch[:whole], ebatch[whole:], []
        elif len(ebatch) == SHORT.max_samples:
            event, lost = "full", []
            released, ebatch = ebatch[: -SHORT.horizon], ebatch[-SHORT.horizon :]
        else:
            assert not episode.full
            continue
        release = episode.end(event)  # type: ignore[arg-type]
        assert [s.sequence for s in release.steps[: release.count]] == released
        assert (release.dropped, release.fitness, release.ending) == (len(lost), fitness, event)
        assert [s.sequence for s in episode.steps] == ebatch
        stored += released
        dropped += lost
    assert sorted(stored + dropped + ebatch) == list(range(len(events)))


def test_500_samples_without_a_bump_release_450_and_carry_50() -> None:
    episode = OpenEpisode(EpisodeConfig())
    for sequence in range(499):
        episode.add(make_step(sequence))
    assert not episode.full
    episode.add(make_step(499))
    assert episode.full
    with pytest.raises(ValueError, match="500"):
        episode.add(make_step(500))
    release = episode.end("full")
    assert (release.count, release.dropped, release.fitness, len(release.steps)) == (
        450,
        0,
        500,
        500,
    )
    assert [s.sequence for s in episode.steps] == list(range(450, 500))
    for sequence in range(500, 950):
        episode.add(make_step(sequence))
    release = episode.end("full")
    assert (release.steps[0].sequence, release.count, release.fitness) == (450, 450, 500)


def test_a_bump_after_a_carry_over_releases_the_carried_ones_too() -> None:
    episode = OpenEpisode(SHORT)
    for sequence in range(12):
        episode.add(make_step(sequence))
    episode.end("full")
    episode.add(make_step(12))
    release = episode.end("bump")
    assert [s.sequence for s in release.steps] == [8, 9, 10, 11, 12]
    assert (release.count, release.fitness, len(episode)) == (5, 5, 0)


def test_a_bump_at_the_last_possible_sample_releases_all_of_them() -> None:
    episode = OpenEpisode(SHORT)
    for sequence in range(12):
        episode.add(make_step(sequence))
    assert episode.end("bump").count == 12


def test_a_bump_without_an_action_and_a_full_end_too_early_are_refused() -> None:
    episode = OpenEpisode(SHORT)
    with pytest.raises(ValueError, match="action"):
        episode.end("bump")
    episode.add(make_step(0))
    with pytest.raises(ValueError, match="12"):
        episode.end("full")
    assert len(episode) == 1


def test_an_interruption_with_no_steps_or_few_releases_nothing() -> None:
    episode = OpenEpisode(SHORT)
    release = episode.end("interrupted")
    assert (release.count, release.dropped) == (0, 0)
    for sequence in range(4):
        episode.add(make_step(sequence))
    release = episode.end("interrupted")
    assert (release.count, release.dropped, len(episode)) == (0, 4, 0)


# ------------------------------------------------------------------------- Actor

CONFIG = make_config(
    episode={"max_samples": 12, "horizon": 4},
    robot={"id": "robot1"},
    memory={"capacity": 30, "fill": "none"},
)
REACH = CONFIG.max_distance_m


def place_of(sequence: int) -> tuple[float, float]:
    return round(math.cos(sequence) * 0.3, 3), round(math.sin(sequence * 1.3) * 0.3, 3)


def observe(sequence: int, **given: Any) -> Observation:
    x_m, y_m = place_of(sequence)
    return make_observation(sequence, x_m=x_m, y_m=y_m, heading_rad=0.5, **given)


def progress(**given: Any) -> RobotProgress:
    plain: dict[str, Any] = {
        "robot": "robot1",
        "filling": False,
        "fill_missing": 0,
        "robot_fills": 0,
        "robot_episodes": 0,
        "episode": 0,
        "robot_life": "",
        "last_sequence": -1,
    }
    return RobotProgress(**{**plain, **given})


def make_actor(version: int = 1) -> tuple[Actor, FakePredictor]:
    predictor = FakePredictor(version)
    return Actor(CONFIG, "robot1", LIFE, predictor), predictor  # type: ignore[arg-type]


def sequences(episode: Episode) -> list[int]:
    return [
        int.from_bytes(episode.images[i * 3750 : i * 3750 + 4], "little")
        for i in range(episode.count)
    ]


class Replay:
    """Stands in for replay: accepts everything, and counts."""

    def __init__(self) -> None:
        self.episodes: list[Episode] = []

    def commit(self, episode: Episode) -> RobotProgress:
        self.episodes.append(episode)
        return self.progress()

    def progress(self) -> RobotProgress:
        if not self.episodes:
            return progress()
        last = self.episodes[-1]
        return progress(
            robot_episodes=len(self.episodes),
            episode=len(self.episodes),
            robot_life=last.robot_life,
            last_sequence=last.last_sequence,
        )

    @property
    def dropped(self) -> int:
        return sum(e.dropped_samples for e in self.episodes)


def finish(actor: Actor, observation: Observation) -> Episode | None:
    """Let an observation end the episode that tells: the robot executed what this actor sent."""
    action = actor.open.steps[-1].action if len(actor.open) else None
    told = {"action": action, "actor_life": actor.life if len(actor.open) else ""}
    return actor.finish(observation.model_copy(update=told))


def drive(actor: Actor, replay: Replay, observation: Observation) -> Action:
    """One observation as the service handles it: finish, commit, act."""
    episode = finish(actor, observation)
    if episode is not None:
        actor.committed(replay.commit(episode))
    return actor.act(observation)


@FAST
@given(st.lists(st.sampled_from(["go"] * 10 + ["bump", "late", "new weights"]), max_size=80))
def test_actor_stores_each_action_once_with_the_rewards_of_the_rules(events: list[str]) -> None:
    (actor, predictor), replay = make_actor(), Replay()
    actor.begin(progress(), observe(0))
    drive(actor, replay, observe(0))
    ebatch: list[int] = [0]
    expected: list[tuple[str, list[int], list[int], int]] = []
    for sequence, event in enumerate(events, start=1):
        if event == "new weights":
            predictor.version += 1
            event = "go"
        n, horizon = len(ebatch), SHORT.horizon
        if event == "late":
            keep = max(n - horizon, 0)
            expected.append(("interrupted", ebatch[:keep], ebatch, predictor.version))
            ebatch = []
        elif event == "bump":
            expected.append(("bump", ebatch, ebatch, predictor.version))
            ebatch = []
        elif n == SHORT.max_samples:
            expected.append(("full", ebatch[:-horizon], ebatch, predictor.version))
            ebatch = ebatch[-horizon:]
        bump, interruption = event == "bump", "late" if event == "late" else ""
        drive(actor, replay, observe(sequence, bump=bump, interruption=interruption))
        ebatch = [*ebatch, sequence]
    expected = [one for one in expected if one[1]]
    assert len(replay.episodes) == len(expected)
    for found, (ended, released, seen, version) in zip(replay.episodes, expected, strict=True):
        assert (found.ended, found.bump, sequences(found)) == (ended, ended == "bump", released)
        assert found.fitness == len(seen)
        assert found.weights_version == version
        ahead = [
            max(fake_values(observe(s + 1).image, version)) if s != seen[-1] else 0.0
            for s in released
        ]
        wanted = oracles.rewards([place_of(s) for s in seen], ahead, ended == "bump", 4, REACH)
        assert list(np.frombuffer(found.sample_rewards, "<f4")) == pytest.approx(wanted, abs=1e-5)
    stored = [s for e in replay.episodes for s in sequences(e)]
    open_now = [s.sequence for s in actor.open.steps]
    assert len(stored) == len(set(stored))
    assert not set(stored) & set(open_now)
    assert len(stored) + len(open_now) + actor.dropped_samples == len(events) + 1
    assert sum(e.actions for e in replay.episodes) <= actor.actions == len(events) + 1


def test_provenance_of_each_sample_tells_its_step_episode_version_world_and_pose() -> None:
    (actor, predictor), replay = make_actor(version=5), Replay()
    actor.begin(progress(), observe(0))
    for sequence in range(13):
        drive(actor, replay, observe(sequence, world="plus" if sequence < 3 else "minus"))
    predictor.version = 6
    drive(actor, replay, observe(13, world="minus", bump=True))
    full, bump = replay.episodes
    assert (full.ended, bump.ended) == ("full", "bump")
    assert list(np.frombuffer(full.sample_steps, "<u4")) == list(range(8))
    assert (full.worlds, list(full.sample_worlds)) == (("plus", "minus"), [0, 0, 0, 1, 1, 1, 1, 1])
    assert list(np.frombuffer(bump.sample_steps, "<u4")) == [8, 9, 10, 11, 4]
    assert list(np.frombuffer(bump.sample_episodes, "<u4")) == [0, 0, 0, 0, 1]
    assert list(np.frombuffer(bump.sample_versions, "<u4")) == [5, 5, 5, 5, 5]
    assert (bump.actions, bump.fitness, bump.last_sequence) == (1, 5, 12)
    assert bump.worlds == ("minus",)
    poses = np.frombuffer(full.positions, "<f4").reshape(-1, 3)
    expected = [(*place_of(s), 0.5) for s in range(8)]
    assert poses == pytest.approx(np.array(expected), abs=1e-6)


def test_actions_are_drawn_by_robot_episode_and_step() -> None:
    (actor, _), replay = make_actor(), Replay()
    actor.begin(progress(), observe(0))
    for sequence in range(30):
        action = drive(actor, replay, observe(sequence, bump=sequence == 5))
        episode, step = (0, sequence) if sequence < 5 else (1, sequence - 5)
        if sequence >= 17:  # full at 12 unprocessed ones, then every 8 actions
            episode, step = 2 + (sequence - 17) // 8, 4 + (sequence - 17) % 8
        draw = generator(CONFIG.run.seed, "policy", "robot1", episode, step)
        values = np.array(fake_values(observe(sequence).image, 1), np.float32)
        assert (action.action, action.by == "network") == choose(values, CONFIG.policy, draw)
        assert action.values == tuple(float(v) for v in values)
        assert (action.sequence, action.robot_life, action.attempt) == (sequence, LIFE, 0)


def driven_by_a_person(keep: bool, wishes: tuple[int | None, ...]) -> tuple[Actor, Episode | None]:
    """An actor after these wishes and a bump, and what it would store."""
    config = make_config(robot={"id": "robot1"}, memory={"keep_human": keep})
    actor = Actor(config, "robot1", LIFE, FakePredictor())  # type: ignore[arg-type]
    actor.begin(progress(), observe(0))
    for sequence, wish in enumerate(wishes):
        assert finish(actor, observe(sequence)) is None
        action = actor.act(observe(sequence), wish=wish)
        assert wish is None or (action.action, action.by) == (wish, "human")
    return actor, finish(actor, observe(len(wishes), bump=True))


@pytest.mark.parametrize(("keep", "stored"), [(True, [0, 1, 2, 3]), (False, [0, 3])])
def test_what_a_person_chose_is_a_sample_that_says_so(keep: bool, stored: list[int]) -> None:
    wishes = (None, 2, 1, None)
    (actor, episode), (_, every) = (driven_by_a_person(k, wishes) for k in (keep, True))
    assert episode is not None
    assert every is not None
    assert list(np.frombuffer(episode.sample_steps, "<u4")) == stored
    human = [CHOOSERS[i] == "human" for i in episode.sample_by]
    assert human == [i in (1, 2) for i in stored]
    assert (actor.human_actions, episode.actions) == (2, 4)
    assert episode.dropped_samples == 4 - len(stored)
    rewards = [np.frombuffer(each.sample_rewards, "<f4") for each in (every, episode)]
    assert rewards[0][stored].tolist() == rewards[1].tolist()  # they look ahead over all steps


def test_an_episode_of_a_person_alone_may_be_left_out() -> None:
    actor, episode = driven_by_a_person(False, (1,))
    assert episode is None
    assert (actor.dropped_samples, actor.dropped_episodes, actor.at_boundary) == (1, 1, True)
    actor.act(observe(1))
    episode = finish(actor, observe(2, bump=True))
    assert episode is not None
    assert (episode.actions, episode.dropped_samples, episode.dropped_episodes) == (2, 1, 1)


def test_filling_acts_uniformly_at_random_and_marks_its_submissions() -> None:
    config = make_config(robot={"id": "robot1"}, memory={"capacity": 500})
    actor = Actor(config, "robot1", LIFE, FakePredictor())  # type: ignore[arg-type]
    actor.begin(progress(filling=True, fill_missing=500, robot_fills=2), observe(0))
    actions = []
    for sequence in range(300):
        actions.append(actor.act(observe(sequence)))
    assert min(np.bincount([a.action for a in actions], minlength=3)) > 60
    assert {a.by for a in actions} == {"chance"}
    episode = finish(actor, observe(300, bump=True))
    assert episode is not None
    assert episode.fill
    assert set(np.frombuffer(episode.sample_episodes, "<u4")) == {2}


def test_a_bump_before_the_first_action_stores_nothing() -> None:
    """E11: contact that still holds at the start ends no episode; one action is always taken."""
    (actor, _), replay = make_actor(), Replay()
    actor.begin(progress(), observe(0, bump=True))
    assert finish(actor, observe(0, bump=True)) is None
    drive(actor, replay, observe(0, bump=True))
    drive(actor, replay, observe(1, bump=True))
    (episode,) = replay.episodes
    assert (episode.count, episode.fitness) == (1, 1)
    assert list(np.frombuffer(episode.sample_rewards, "<f4")) == [-1.0]


def test_a_bump_on_the_action_that_fills_the_episode_is_a_bump() -> None:
    (actor, _), replay = make_actor(), Replay()
    actor.begin(progress(), observe(0))
    for sequence in range(12):
        drive(actor, replay, observe(sequence))
    drive(actor, replay, observe(12, bump=True))
    (episode,) = replay.episodes
    assert (episode.ended, episode.count) == ("bump", 12)


@pytest.mark.parametrize(
    "broken",
    [
        {"interruption": "pause"},
        {"interruption": "moved", "bump": True},
        {"bump": True, "sequence": 9},
        {"life": OTHER_LIFE},
        {"sequence": 9},
        {"sequence": 4},
    ],
)
def test_what_breaks_the_sequence_interrupts_the_episode(broken: dict[str, Any]) -> None:
    (actor, _), replay = make_actor(), Replay()
    actor.begin(progress(), observe(0))
    for sequence in range(7):
        drive(actor, replay, observe(sequence))
    observation = observe(**{"sequence": 7, **broken})
    episode = finish(actor, observation)
    assert episode is not None
    assert (episode.ended, episode.bump, sequences(episode)) == ("interrupted", False, [0, 1, 2])
    assert (episode.dropped_samples, episode.dropped_episodes) == (4, 0)
    assert len(actor.open) == 0
    assert episode.robot_life == LIFE


@pytest.mark.parametrize("interruption", ["estop", "pause", "late", "blocked", "restart", "world"])
def test_a_bump_seen_together_with_an_interruption_is_settled_first(interruption: str) -> None:
    """E42: all samples of the episode are complete; what follows begins a new one."""
    (actor, _), replay = make_actor(), Replay()
    actor.begin(progress(), observe(0))
    for sequence in range(7):
        drive(actor, replay, observe(sequence))
    drive(actor, replay, observe(7, attempt=1, bump=True, interruption=interruption))
    (episode,) = replay.episodes
    assert (episode.ended, episode.bump, sequences(episode)) == ("bump", True, list(range(7)))
    assert episode.dropped_samples == 0
    assert np.frombuffer(episode.sample_rewards, "<f4")[-1] == -1.0
    assert [step.sequence for step in actor.open.steps] == [7]


def test_contact_of_a_motion_interrupts_the_episode_and_is_no_bump() -> None:
    """E42: turning on the spot and creeping are no actions."""
    (actor, _), replay = make_actor(), Replay()
    actor.begin(progress(), observe(0))
    for sequence in range(7):
        drive(actor, replay, observe(sequence))
    episode = finish(actor, observe(7, bump=True, interruption="moved"))
    assert episode is not None
    assert (episode.ended, sequences(episode)) == ("interrupted", [0, 1, 2])
    assert episode.dropped_samples == 4


def test_an_action_that_was_never_executed_is_neither_sample_nor_action() -> None:
    (actor, _), replay = make_actor(), Replay()
    actor.begin(progress(), observe(0))
    for sequence in range(8):
        drive(actor, replay, observe(sequence))
    episode = finish(actor, observe(7, attempt=1, interruption="late"))
    assert episode is not None
    assert (sequences(episode), episode.dropped_samples) == ([0, 1, 2], 4)
    assert (episode.actions, episode.fitness, episode.last_sequence) == (7, 7, 6)


def test_contact_before_the_action_began_belongs_to_the_action_before() -> None:
    """E6: in real time the robot may touch the wall while the next action is still chosen."""
    (actor, _), replay = make_actor(), Replay()
    actor.begin(progress(), observe(0))
    for sequence in range(3):
        drive(actor, replay, observe(sequence))
    drive(actor, replay, observe(2, attempt=1, bump=True))
    (episode,) = replay.episodes
    assert (episode.ended, sequences(episode), episode.actions) == ("bump", [0, 1], 2)
    drive(actor, replay, observe(3))
    assert [s.sequence for s in actor.open.steps] == [2, 3]


def test_a_second_look_without_an_interruption_continues_the_episode() -> None:
    (actor, _), replay = make_actor(), Replay()
    actor.begin(progress(), observe(0))
    for sequence in range(3):
        drive(actor, replay, observe(sequence))
    drive(actor, replay, observe(2, attempt=1))
    drive(actor, replay, observe(3, bump=True))
    assert sequences(replay.episodes[0]) == [0, 1, 2]


def test_a_short_interrupted_episode_is_reported_with_the_next_submission() -> None:
    (actor, _), replay = make_actor(), Replay()
    actor.begin(progress(), observe(0))
    for sequence in range(3):
        drive(actor, replay, observe(sequence))
    assert finish(actor, observe(3, interruption="pause")) is None
    actor.act(observe(3))
    drive(actor, replay, observe(4, bump=True))
    (episode,) = replay.episodes
    assert (episode.dropped_samples, episode.dropped_episodes, episode.actions) == (3, 1, 4)
    drive(actor, replay, observe(5, bump=True))
    assert (replay.episodes[1].dropped_samples, replay.episodes[1].dropped_episodes) == (0, 0)


def test_weights_may_change_at_the_boundary_only() -> None:
    (actor, _), replay = make_actor(), Replay()
    actor.begin(progress(), observe(0))
    assert actor.at_boundary
    drive(actor, replay, observe(0))
    assert not actor.at_boundary
    finish(actor, observe(1))
    assert not actor.at_boundary
    finish(actor, observe(1, bump=True))
    assert actor.at_boundary


def test_rewards_use_the_version_in_force_when_they_are_computed() -> None:
    """Carried-over samples are predicted anew (A17); the terminal sample's successor is not."""
    (actor, predictor), replay = make_actor(version=3), Replay()
    actor.begin(progress(), observe(0))
    for sequence in range(13):
        drive(actor, replay, observe(sequence))
    predictor.version = 4
    drive(actor, replay, observe(13, bump=True))
    bump = replay.episodes[1]
    seen = [8, 9, 10, 11, 12]
    ahead = [max(fake_values(observe(s).image, 4)) for s in seen[1:]] + [0.0]
    wanted = oracles.rewards([place_of(s) for s in seen], ahead, True, 4, REACH)
    assert list(np.frombuffer(bump.sample_rewards, "<f4")) == pytest.approx(wanted, abs=1e-5)
    assert bump.weights_version == 4


@FAST
@given(
    events=st.lists(st.sampled_from(["go"] * 4 + ["bump", "late"]), min_size=1, max_size=60),
    cut=st.integers(0, 59),
)
@example(events=["go", "go", "bump", "go", "go", "bump", "go"], cut=4)
@example(events=["go"] * 16 + ["bump", "go", "late"], cut=14)
def test_a_restored_actor_continues_as_if_nothing_had_happened(events: list[str], cut: int) -> None:
    runs = []
    cut = min(cut, len(events) - 1)
    for restart_at in (None, cut):
        (actor, predictor), replay = make_actor(), Replay()
        first = observe(0)
        actor.begin(progress(), first)
        actions = []
        for sequence, event in enumerate(events):
            observation = observe(
                sequence,
                bump=event == "bump",
                interruption="late" if event == "late" else "",
                laps_left=sequence // 3,
            )
            if sequence == restart_at:
                state = msgpack.unpackb(msgpack.packb(actor.state()))
                actor = Actor(CONFIG, "robot1", LIFE, predictor)  # type: ignore[arg-type]
                actor.restore(state)
                actor.begin(replay.progress(), observation)
            actions.append(drive(actor, replay, observation))
        # A process numbers its submissions from 0.
        episodes = [e.model_copy(update={"number": 0}) for e in replay.episodes]
        runs.append((actions, episodes, actor.state()))
    assert runs[0] == runs[1]


def restored(actor: Actor, life: str) -> Actor:
    """The same actor in a new process."""
    other, _ = make_actor()
    other = Actor(CONFIG, "robot1", life, FakePredictor())  # type: ignore[arg-type]
    other.restore(msgpack.unpackb(msgpack.packb(actor.state())))
    return other


def test_a_restored_actor_has_a_life_of_its_own_and_knows_its_earlier_actions() -> None:
    (actor, _), replay = make_actor(), Replay()
    actor.begin(progress(), observe(0))
    for sequence in range(6):
        drive(actor, replay, observe(sequence))
    other = restored(actor, OTHER_LIFE)
    observation = observe(
        6, bump=True, action=actor.open.steps[-1].action, actor_life=LIFE, life=NEXT_LIFE,
        earlier=(LIFE,),
    )  # fmt: skip
    other.begin(replay.progress(), observation)
    episode = other.finish(observation)
    assert episode is not None
    assert (episode.ended, episode.life, episode.number) == ("bump", OTHER_LIFE, 0)
    assert (sequences(episode), episode.robot_life) == ([0, 1, 2, 3, 4, 5], NEXT_LIFE)


@pytest.mark.parametrize("told", [{"action": 1}, {"actor_life": OTHER_LIFE}, {"action": None}])
def test_what_another_actor_had_executed_is_never_stored(told: dict[str, Any]) -> None:
    (actor, _), replay = make_actor(), Replay()
    actor.begin(progress(), observe(0))
    for sequence in range(7):
        drive(actor, replay, observe(sequence))
    mine = actor.open.steps[-1].action
    told = {"action": mine, "actor_life": LIFE, **told}
    if told["action"] == 1:
        told["action"] = (mine + 1) % 3
    episode = actor.finish(observe(7, bump=True, **told))
    assert episode is not None
    assert (episode.ended, sequences(episode)) == ("interrupted", [0, 1])
    assert (episode.last_sequence, episode.actions, actor.foreign_actions) == (5, 6, 1)
    drive(actor, replay, observe(7, bump=True))
    drive(actor, replay, observe(8, bump=True))
    assert sequences(replay.episodes[-1]) == [7]


def test_steps_that_replay_has_already_are_not_stored_again() -> None:
    (actor, _), replay = make_actor(), Replay()
    actor.begin(progress(), observe(0))
    for sequence in range(6):
        drive(actor, replay, observe(sequence))
    for stored in (
        {"robot_life": LIFE, "last_sequence": 20},  # another process went on with this driver
        {"robot_life": NEXT_LIFE, "last_sequence": 3},  # and with the next
    ):
        other = restored(actor, OTHER_LIFE)
        other.begin(progress(**stored), observe(22, life=stored["robot_life"]))
        assert len(other.open) == 0
        assert finish(other, observe(22, life=stored["robot_life"])) is None


def test_a_submission_that_is_refused_is_counted_as_dropped() -> None:
    (actor, _), replay = make_actor(), Replay()
    actor.begin(progress(), observe(0))
    for sequence in range(3):
        drive(actor, replay, observe(sequence))
    episode = finish(actor, observe(3, bump=True))
    assert episode is not None
    actor.lose(episode, "c" * 12)
    actor.begin(replay.progress(), observe(3, bump=True))
    actor.act(observe(3, bump=True))
    drive(actor, replay, observe(4, bump=True))
    (after,) = replay.episodes
    assert (after.life, after.number) == ("c" * 12, 0)  # the numbers of the old life may be taken
    assert (after.dropped_samples, after.dropped_episodes) == (3, 1)


def test_damaged_saved_state_is_told_by_its_kind_of_error() -> None:
    (actor, _), replay = make_actor(), Replay()
    actor.begin(progress(), observe(0))
    drive(actor, replay, observe(0))
    for damage in ({"steps": [{"image": b""}]}, {"laps_before": [1]}, {"expected": [1]}):
        other, _ = make_actor()
        with pytest.raises((KeyError, TypeError, ValueError, IndexError)):
            other.restore({**actor.state(), **damage})
    for name in actor.state():
        other, _ = make_actor()
        state = actor.state()
        del state[name]
        with pytest.raises(KeyError):
            other.restore(state)


# ------------------------------------------------------- actions lost with an actor process


def test_a_new_actor_counts_what_its_predecessor_lost() -> None:
    (actor, _), replay = make_actor(), Replay()
    actor.begin(progress(robot_life=LIFE, last_sequence=40), observe(48))
    assert (actor.dropped_samples, actor.dropped_episodes) == (7, 1)
    drive(actor, replay, observe(48))
    drive(actor, replay, observe(49, bump=True))
    assert (replay.episodes[0].dropped_samples, replay.episodes[0].dropped_episodes) == (7, 1)


def test_a_new_actor_at_the_newest_stored_sample_lost_nothing() -> None:
    actor, _ = make_actor()
    actor.begin(progress(robot_life=LIFE, last_sequence=40), observe(41))
    assert (actor.dropped_samples, actor.dropped_episodes) == (0, 0)


def test_a_first_actor_before_a_fresh_driver_lost_nothing() -> None:
    actor, _ = make_actor()
    actor.begin(progress(), observe(0))
    assert (actor.dropped_samples, actor.dropped_episodes) == (0, 0)


def test_a_first_actor_counts_what_an_unknown_one_did_before_storing_anything() -> None:
    actor, _ = make_actor()
    actor.begin(progress(), observe(9))
    assert (actor.dropped_samples, actor.dropped_episodes) == (9, 1)


def test_with_driver_and_actor_lost_all_actions_of_the_new_driver_life_count() -> None:
    actor, _ = make_actor()
    actor.begin(progress(robot_life=OTHER_LIFE, last_sequence=70), observe(6))
    assert (actor.dropped_samples, actor.dropped_episodes) == (6, 1)


@FAST
@given(st.lists(st.sampled_from(["go"] * 8 + ["bump", "late", "hold", "kill actor"]), max_size=80))
def test_lost_actions_are_counted_once_whoever_is_killed_and_interrupted(events: list[str]) -> None:
    """Executed = stored + reported as dropped + not yet reported; nothing twice."""
    (actor, _), replay = make_actor(), Replay()
    actor.begin(replay.progress(), observe(0))
    drive(actor, replay, observe(0))
    sequence = 0  # of the newest observation; its action is given, not yet executed
    for event in events:
        interruption = "late" if event in ("late", "hold") else ""
        if event != "hold":  # a hold: the action given was not executed
            sequence += 1
        observation = observe(
            sequence, attempt=int(event == "hold"), bump=event == "bump", interruption=interruption
        )
        if event == "kill actor":
            actor = Actor(CONFIG, "robot1", NEXT_LIFE, FakePredictor())  # type: ignore[arg-type]
            actor.begin(replay.progress(), observation)
        drive(actor, replay, observation)
        stored = sum(e.count for e in replay.episodes)
        executed_open = len(actor.open) - 1
        waiting = actor.state()["_unreported_samples"]
        assert stored + replay.dropped + waiting + executed_open == sequence
