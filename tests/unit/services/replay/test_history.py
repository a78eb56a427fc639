"""A memory has one history: what contradicts it is refused, and no mirror goes on with another."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builders import FakePredictor, make_episode

from services.learner.mirror import Mirror
from services.replay import numbering
from services.replay import storage as storage_module
from services.replay.service import HEARD_S, VERSION_PATIENCE_S, Intake
from services.replay.storage import Refused, Storage
from shared.config import MemoryConfig
from shared.errors import PeerSilent
from shared.keys import CHANGES
from shared.messages import NO_LINEAGE, Change, Episode, FeedEnd
from shared.rl.schedule import Moment
from shared.rl.turn import maintain

CONFIG = MemoryConfig(capacity=30, fill="none", equalise_every=2)
FILLED = MemoryConfig(capacity=30)


class Memory:
    """A storage and the thread that does its turns, in one."""

    def __init__(self, folder: Path, config: MemoryConfig = CONFIG) -> None:
        self.config = config
        self.storage = Storage(folder, config, "run/1")
        self._memory = self.storage.load()

    def store(self, *episodes: Episode) -> None:
        predictor: Any = FakePredictor()
        for episode in episodes:
            self.storage.commit(episode)
            pending = self.storage.pending(self.storage.position().processed)
            assert pending is not None
            self._memory.append(pending.rows, pending.images)
            now = Moment(pending.commit.episode)
            done = maintain(self._memory, now, self.config, predictor, seed=1)
            self.storage.apply_turn(pending, self._memory, done)

    def request_many(self, stream: Any, request: Any, *types: Any, **_: Any) -> Any:
        """What a learner's bus gets for an answer."""
        feed = self.storage.feed
        if stream is CHANGES:
            return feed.changes(request.since, request.upto, request.lineage)
        return feed.snapshot()

    @property
    def place(self) -> tuple[int, str]:
        position = self.storage.position()
        return position.change, position.lineage


@pytest.fixture
def memory(tmp_path: Path) -> Iterator[Memory]:
    made = Memory(tmp_path / "replay")
    yield made
    made.storage.close()


def same(mirror: Mirror, memory: Memory) -> bool:
    loaded = memory.storage.load()
    every = np.arange(len(loaded))
    return (
        mirror.samples.rows["id"].tolist() == loaded.rows["id"].tolist()
        and mirror.samples.images(every).tobytes() == loaded.images(every).tobytes()
        and mirror.samples.rows["reward"].tobytes() == loaded.rows["reward"].tobytes()
    )


# ------------------------------------------------------------------------- lineage


def test_a_memory_restored_from_a_backup_goes_on_as_another_one(
    memory: Memory, tmp_path: Path
) -> None:
    memory.store(*[make_episode(5, seed=seed) for seed in range(3)])
    shutil.copytree(tmp_path / "replay", tmp_path / "backup")
    memory.store(make_episode(5, seed=3), make_episode(5, seed=4))
    mirror = Mirror()
    mirror.reach(memory, *memory.place)  # type: ignore[arg-type]
    restored = Memory(tmp_path / "backup")
    restored.store(*[make_episode(5, seed=seed) for seed in (13, 14, 15)])
    assert restored.storage.turns(2, 1)[0].lineage == memory.storage.turns(2, 1)[0].lineage
    assert restored.storage.turns(3, 1)[0].lineage != memory.storage.turns(3, 1)[0].lineage
    mirror.reach(restored, *restored.place)  # type: ignore[arg-type]
    assert mirror.resyncs == 1
    assert (mirror.number, mirror.lineage) == restored.place
    assert same(mirror, restored)
    restored.storage.close()


def test_a_mirror_of_a_common_past_needs_no_snapshot(memory: Memory, tmp_path: Path) -> None:
    memory.store(make_episode(5, seed=0))
    mirror = Mirror()
    mirror.reach(memory, *memory.place)  # type: ignore[arg-type]
    shutil.copytree(tmp_path / "replay", tmp_path / "backup")
    restored = Memory(tmp_path / "backup")
    restored.store(make_episode(40, seed=9), make_episode(40, seed=10))
    mirror.reach(restored, *restored.place)  # type: ignore[arg-type]
    assert mirror.resyncs == 0
    assert same(mirror, restored)
    restored.storage.close()


def test_lineage_depends_on_content_identity_and_order() -> None:
    one, two = ("a/0/0", "1" * 16), ("a/0/1", "2" * 16)

    def chain(*episodes: tuple[str, str]) -> str:
        lineage = NO_LINEAGE
        for episode in episodes:
            lineage = numbering.lineage_after(lineage, *episode)
        return lineage

    chains = [
        *(chain(), chain(one), chain(two), chain(one, two), chain(two, one)),
        *(chain(("a/0/0", "2" * 16)), chain(one, one)),
    ]
    assert len(set(chains)) == len(chains)
    assert {len(lineage) for lineage in chains} == {16}


def test_a_submission_that_changes_nothing_leaves_the_lineage_of_its_change(tmp_path: Path) -> None:
    """Otherwise every learner would take a snapshot after a robot's late last filling."""
    memory = Memory(tmp_path / "replay", FILLED)
    memory.store(make_episode(30, seed=0, fill=True))
    place = memory.place
    memory.store(make_episode(5, seed=1, fill=True, robot="robot2"))
    assert memory.place == place
    assert memory.storage.position().processed == 2
    memory.store(make_episode(5, seed=2))
    *_, end = memory.storage.feed.changes(*(place[0], memory.place[0], place[1]))
    assert isinstance(end, FeedEnd)
    assert (end.gone, end.lineage) == (False, memory.place[1])
    memory.storage.close()


def test_a_wrong_lineage_gets_no_changes(memory: Memory) -> None:
    memory.store(make_episode(5, seed=0), make_episode(5, seed=1))
    for since in range(memory.place[0] + 2):
        (end,) = memory.storage.feed.changes(since, memory.place[0], "f" * 16)
        assert isinstance(end, FeedEnd)
        assert (end.gone, end.lineage) == (True, memory.place[1])


def test_a_transfer_that_does_not_fit_is_repeated_as_a_snapshot(memory: Memory) -> None:
    memory.store(make_episode(5, seed=0))
    mirror = Mirror()
    mirror.reach(memory, *memory.place)  # type: ignore[arg-type]
    memory.store(make_episode(5, seed=1))
    number, lineage = memory.place
    unknown = np.array([77], "<u8").tobytes()
    forged = [
        Change(number=number, last=True, kind="discard", ids=unknown),
        FeedEnd(change=number, rows=1, messages=1, lineage=lineage),
    ]
    liar: Any = SimpleNamespace(request_many=lambda *_, **__: iter(forged))
    for _ in range(2):  # asked for changes, then for a snapshot
        with pytest.raises(PeerSilent, match="does not fit the mirror"):
            mirror.reach(liar, number, lineage)
        assert mirror.number is None
    mirror.reach(memory, number, lineage)  # type: ignore[arg-type]
    assert same(mirror, memory)


def test_a_snapshot_of_another_history_is_not_taken(memory: Memory) -> None:
    memory.store(make_episode(5, seed=0))
    mirror = Mirror()
    with pytest.raises(PeerSilent, match="expected 1 of ffff"):
        mirror.reach(memory, 1, "f" * 16)  # type: ignore[arg-type]
    assert mirror.number is None


# ------------------------------------------------------------------------- refused for good


@pytest.mark.parametrize(
    "other",
    [
        {"images": np.zeros((5, 50, 75), np.uint8)},
        {"sample_rewards": bytes(20)},
        {"fitness": 9},
        {"ended": "full"},
        {"last_sequence": 30_009},
    ],
    ids=lambda other: next(iter(other)),
)
def test_the_same_identity_with_other_content_is_no_duplicate(
    memory: Memory, other: dict[str, Any]
) -> None:
    memory.storage.commit(make_episode(5, seed=3))
    with pytest.raises(Refused, match=r"identity: robot1/a{12}/3 is stored with other content"):
        memory.storage.commit(make_episode(5, seed=3, **other))
    assert memory.storage.commit(make_episode(5, seed=3)).duplicate


@pytest.mark.parametrize(
    ("last_sequence", "fits"), [(0, False), (9, False), (13, False), (14, True), (99, True)]
)
def test_samples_of_one_driver_life_never_overlap(
    memory: Memory, last_sequence: int, fits: bool
) -> None:
    memory.storage.commit(make_episode(5, seed=0, last_sequence=9))
    later = make_episode(5, seed=1, last_sequence=last_sequence)
    if fits:
        memory.storage.commit(later)
        return
    with pytest.raises(Refused, match=f"sequences: 5 samples up to {last_sequence} of robot life"):
        memory.storage.commit(later)
    for other in ({"robot": "robot2"}, {"robot_life": "c" * 12}):
        if last_sequence >= 4:
            memory.storage.commit(later.model_copy(update={**other, "number": 7}))


def test_a_submission_far_ahead_of_the_robot_keeps_none_of_its_own_away(memory: Memory) -> None:
    memory.storage.commit(make_episode(5, seed=0, last_sequence=9))
    for number in range(40):
        far = {"number": 100 + number, "last_sequence": 2**32 - 1 - 20_000 * number}
        memory.storage.commit(make_episode(5, seed=1, **far))
        own = {"number": 200 + number, "last_sequence": 14 + 5 * number}
        memory.storage.commit(make_episode(5, seed=2, **own))
        with pytest.raises(Refused, match="sequences: "):
            memory.storage.commit(make_episode(5, seed=3, **{**own, "number": 300}))


def test_an_earlier_driver_life_is_not_forgotten(memory: Memory) -> None:
    first, second = {"robot_life": "c" * 12}, {"robot_life": "d" * 12}
    memory.storage.commit(make_episode(5, seed=0, last_sequence=9, **first))
    memory.storage.commit(make_episode(5, seed=1, last_sequence=4, **second))
    with pytest.raises(Refused, match="sequences: "):
        memory.storage.commit(make_episode(5, seed=2, last_sequence=9, **first))


def test_lost_samples_may_be_of_an_earlier_driver_life(memory: Memory) -> None:
    memory.storage.commit(make_episode(5, seed=0, last_sequence=9))
    lost = make_episode(5, seed=1, last_sequence=14, dropped_samples=100)
    assert memory.storage.commit(lost).counters.dropped_samples == 100


def test_more_samples_than_actions_of_a_life_are_refused(memory: Memory) -> None:
    with pytest.raises(Refused, match="sequences: 5 samples up to 3 "):
        memory.storage.commit(make_episode(5, last_sequence=3))


def test_weights_that_acted_are_no_newer_than_those_that_predicted(memory: Memory) -> None:
    versions = np.array([1, 8, 1, 1, 1], "<u4").tobytes()
    with pytest.raises(Refused, match="versions: weights 8 acted, but 7 predicted"):
        memory.storage.commit(make_episode(5, weights_version=7, sample_versions=versions))
    memory.storage.commit(make_episode(5, weights_version=8, sample_versions=versions))


def test_filling_is_refused_where_there_is_nothing_to_fill(memory: Memory, tmp_path: Path) -> None:
    with pytest.raises(Refused, match="fill: the memory is not being filled"):
        memory.storage.commit(make_episode(5, fill=True))
    filled = Storage(tmp_path / "filled", FILLED, "run/1")
    filled.commit(make_episode(30, seed=0, fill=True))
    with pytest.raises(Refused, match="fill: the memory is not being filled"):
        filled.commit(make_episode(5, seed=1, fill=True))
    late = {"robot": "robot2", "fill": True}
    assert filled.commit(make_episode(5, seed=2, **late)).commit.stored == 0
    with pytest.raises(Refused, match="fill: the memory is not being filled"):
        filled.commit(make_episode(5, seed=3, **late))
    filled.commit(make_episode(5, seed=4, robot="robot2"))
    filled.close()


def test_names_are_bounded(memory: Memory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(storage_module, "MAX_WORLDS", 2)
    monkeypatch.setattr(numbering, "MAX_ROBOTS", 1)
    memory.storage.commit(make_episode(2, seed=0, worlds=("plus", "minus")))
    with pytest.raises(Refused, match="worlds: expected at most 2"):
        memory.storage.commit(make_episode(2, seed=1, worlds=("plus", "i16c")))
    with pytest.raises(Refused, match="robots: expected at most 1"):
        memory.storage.commit(make_episode(2, seed=2, robot="robot2"))
    memory.storage.commit(make_episode(2, seed=3))
    assert memory.storage.counters().commit == 2


# ------------------------------------------------------------------------- the service


class Desk:
    """The part of the intake thread that answers submissions, beside a learner that is heard."""

    def __init__(self, memory: Memory) -> None:
        self.lines: list[str] = []
        self.weights = SimpleNamespace(newest=(3, b""), heard=(3, 0.0))
        me = SimpleNamespace(
            config=SimpleNamespace(memory=memory.config),
            log=SimpleNamespace(warning=self.lines.append),
            bus=SimpleNamespace(inbox=lambda: SimpleNamespace(wake=None)),
            stop=SimpleNamespace(on_set=lambda _: None),
        )
        worker = SimpleNamespace(weights=self.weights, submitted=lambda: None)
        made: Any = (me, memory.storage, Path())
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("services.replay.service.TurnWorker", lambda *_: worker)
            self.intake = Intake(*made)

    def answer(self, episode: Episode) -> Any:
        answers: list[Any] = []
        request: Any = SimpleNamespace(
            message=episode, reply=answers.append, refuse=lambda text: answers.append(text)
        )
        self.intake._answer(request)
        (answer,) = answers
        return answer


def test_a_refusal_is_counted_and_told_once_a_minute_for_each_kind(memory: Memory) -> None:
    desk = Desk(memory)
    assert desk.answer(make_episode(5, seed=1)).accepted
    for seed in range(4):
        ack = desk.answer(make_episode(5, seed=2 + seed, last_sequence=9))
        assert (ack.accepted, ack.progress) == (False, None)
        assert ack.reason.startswith("sequences: ")
    assert not desk.answer(make_episode(5, seed=1, fitness=99)).accepted
    assert desk.intake.refused == 5
    assert [line.partition("refused: ")[2].partition(":")[0] for line in desk.lines] == [
        "sequences",
        "identity",
    ]


def test_an_unknown_version_is_sent_back_until_a_learner_contradicts(memory: Memory) -> None:
    desk, episode = Desk(memory), make_episode(5, weights_version=9)
    assert "is not known here yet" in desk.answer(episode)
    since_s = min(desk.intake._doubted.values())
    late_s = since_s + VERSION_PATIENCE_S + 1.0
    assert desk.intake._exists(episode, late_s)  # nobody says what there is
    desk.weights.heard = (9, late_s)
    assert desk.intake._exists(episode, late_s)  # it is only not fetched yet
    desk.weights.heard = (3, late_s)
    assert desk.intake._exists(episode, since_s + VERSION_PATIENCE_S - 1.0)
    assert not desk.intake._exists(episode, late_s)
    assert desk.intake._exists(episode, late_s + HEARD_S)
    desk.intake._doubted[("robot1", 9)] = -1e9
    desk.weights.heard = (3, float("inf"))
    ack = desk.answer(episode)
    assert (ack.accepted, ack.reason) == (False, "weights_version: the learner has made no 9")
    desk.weights.newest = (9, b"")
    assert desk.answer(episode).accepted
