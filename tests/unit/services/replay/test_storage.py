"""Replay memory on disk against the rules, over restarts, and its feed (A12, A13, E25)."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lmdb
import numpy as np
import oracles
import pytest
from builders import FakePredictor, fake_values, make_episode
from hypothesis import given, settings
from hypothesis import strategies as st

from services.learner import mirror as mirror_module
from services.learner.mirror import Mirror, apply
from services.replay import feed as feed_module
from services.replay import tables as tables_module
from services.replay.storage import Storage
from services.replay.tables import Tables
from shared.config import MemoryConfig
from shared.errors import ConfigError, DiskFull, PeerSilent, StateError
from shared.keys import CHANGES
from shared.messages import NO_LINEAGE, Change, Episode, FeedEnd
from shared.rl.draws import generator
from shared.rl.memory import ReplayMemory, SampleStore
from shared.rl.schedule import Moment
from shared.rl.turn import maintain

SLOW_DISK = settings(deadline=None, max_examples=40, derandomize=True)
IDENTITY = "run1/0123456789abcdef"


class Bench:
    """A storage, the memory of the thread that processes turns, and a model of both.

    The model knows the samples as dicts; `seen` holds, for every change number, what a mirror that
    stands there must hold: (id, action, reward, image) of each sample.
    """

    def __init__(self, folder: Path, **config: Any) -> None:
        self.folder = folder
        self.config = MemoryConfig(
            **{"capacity": 30, "fill": "none", "equalise_every": 3, **config}
        )
        self.storage = Storage(folder, self.config, IDENTITY)
        self.memory = self.storage.load()
        self.version = 1
        self.model: list[dict[str, Any]] = []
        self.percent = self.config.threshold_percent
        self.capacity = self.config.capacity
        self.change = 0
        self.next_id = 1
        self.filled = 0
        self.episodes = 0
        self.commits = 0
        self.seen: dict[int, list[tuple[Any, ...]]] = {0: []}
        self.looked_at = ReplayMemory(1)
        """What somebody beside the process has, who reads what is new now and then."""
        self.history = [NO_LINEAGE]
        """Lineage after each commit."""
        self.lineages = {0: NO_LINEAGE}
        """Lineage as of each change."""

    def reopen(self) -> None:
        """What a kill -9 and a restart do: memory is read from disk, open turns come again."""
        self.storage.close()
        looker = Tables(self.folder, readonly=True)
        looker.update(self.looked_at)
        looker.env.close()
        self.storage = Storage(self.folder, self.config, IDENTITY)
        self.memory = self.storage.load()
        equal_memories(self.looked_at, self.memory)

    def commit(self, episode: Episode) -> None:
        accepted = self.storage.commit(episode)
        self.commits += 1
        self.history.append(chained(self.history[-1], episode))
        stored = episode.count
        if episode.fill:
            stored = min(stored, self.config.capacity - self.filled)
            self.filled += stored
        else:
            self.episodes += 1
        assert not accepted.duplicate
        found = accepted.commit
        assert (found.commit, found.stored) == (self.commits, stored)
        assert found.first_id == self.next_id
        assert found.episode == (0 if episode.fill else self.episodes)
        self.next_id += stored

    def turn(self) -> bool:
        """Process the next commit as replay does; False if there is none."""
        pending = self.storage.pending(self.storage.position().processed)
        if pending is None:
            return False
        commit, rows, images = pending.commit, pending.rows, pending.images
        before = self.change
        self.memory.append(rows, images)
        predictor: Any = FakePredictor(self.version)
        done = maintain(self.memory, Moment(commit.episode), self.config, predictor, seed=1)
        position = self.storage.apply_turn(pending, self.memory, done)
        self._model_turn(rows, images, commit.episode)
        for number in range(before + 1, self.change + 1):
            self.lineages[number] = self.history[commit.commit]
        assert position.lineage == self.lineages[self.change]
        if commit.episode:
            (turn,) = self.storage.turns(commit.episode - 1, 1)
            assert turn.lineage == position.turn_lineage == position.lineage
        assert (position.change, position.kept["threshold_percent"]) == (self.change, self.percent)
        assert position.capacity == self.capacity
        assert position.processed == commit.commit
        return True

    def _model_turn(self, rows: Any, images: Any, episode: int) -> None:
        for row, image in zip(rows, images, strict=True):
            sample = {"id": int(row["id"]), "action": int(row["action"]), "forced": False}
            sample |= {"reward": float(row["reward"]), "image": image.tobytes()}
            sample["episode"] = episode
            self.model.append({**sample, "candidate": False})
        self._note(len(rows))
        decreed = self.config.strategy == "rmm" and self.config.mark_all_at_episode
        if episode and episode == decreed:
            for s in self.model:
                if s["episode"] != episode:
                    s["forced"] = s["candidate"] = True
        samples = [
            oracles.Sample(s["id"], s["action"], s["image"][:15], s["candidate"], s["forced"])
            for s in self.model
        ]
        outcome = oracles.discard(
            samples,
            self.capacity,
            self.percent,
            strategy=self.config.strategy,
            rule=self.config.rule,
            capacity_max=self.config.capacity_max,
            capacity_step=self.config.capacity_step or oracles.scaled(5000, self.config.capacity),
        )
        kept = {s.id: s for s in samples}
        self.model = [s for s in self.model if s["id"] in kept]
        for s in self.model:
            s["candidate"] = kept[s["id"]].candidate
        self.percent, self.capacity = outcome.percent, outcome.capacity
        self._note(len(outcome.removed))
        every = self.config.equalise_every
        if self.model and episode and every and episode % every == 0:
            for s in self.model:
                value = fake_values(s["image"], self.version)[s["action"]]
                s["reward"] = 0.7 * s["reward"] + 0.3 * value
            self._note(1)

    def _note(self, changed: int) -> None:
        if changed:
            self.change += 1
            self.seen[self.change] = [
                (s["id"], s["action"], s["reward"], s["image"]) for s in self.model
            ]

    def check(self) -> None:
        """Disk, memory and model hold the same."""
        loaded = self.storage.load()
        loaded.check_valid()
        assert loaded.capacity == self.memory.capacity == self.capacity
        assert loaded.kept == self.memory.kept
        equal_memories(loaded, self.memory)
        for name in ("id", "action", "candidate", "forced"):
            assert loaded.rows[name].tolist() == [s[name] for s in self.model]
        same_samples(loaded, self.seen[self.change])
        for s, reward in zip(self.model, loaded.rows["reward"].tolist(), strict=True):
            s["reward"] = reward


def equal_memories(one: ReplayMemory, other: ReplayMemory) -> None:
    """Both hold the same samples."""
    for name in one.rows.dtype.names or ():
        if name != "slot":
            assert one.rows[name].tobytes() == other.rows[name].tobytes(), name
    every = np.arange(len(one))
    assert one.images(every).tobytes() == other.images(every).tobytes()


def chained(lineage: str, episode: Episode) -> str:
    """The lineage after one more submission, as docs/protocol.md tells it."""
    name = f"{episode.robot}/{episode.life}/{episode.number}"
    return hashlib.sha256(f"{lineage} {name} {episode.digest}".encode()).hexdigest()[:16]


def same_samples(store: SampleStore, expected: list[tuple[Any, ...]]) -> None:
    images = store.images(np.arange(len(store)))
    assert store.rows["id"].tolist() == [s[0] for s in expected]
    assert store.rows["action"].tolist() == [s[1] for s in expected]
    assert store.rows["reward"].tolist() == pytest.approx([s[2] for s in expected], abs=1e-5)
    assert [i.tobytes() for i in images] == [s[3] for s in expected]


def pulled(replies: Iterator[Change | FeedEnd]) -> tuple[list[Change], FeedEnd]:
    """All parts and the end, whose counts must be right."""
    *parts, end = list(replies)
    assert isinstance(end, FeedEnd)
    assert all(isinstance(part, Change) for part in parts)
    assert end.messages == len(parts)
    assert end.rows == sum(len(part.ids) // 8 for part in parts if isinstance(part, Change))
    return [part for part in parts if isinstance(part, Change)], end


def some_images(n: int, seed: int) -> np.ndarray:
    """Images whose first 15 bytes, the descriptor, often resemble each other."""
    rng = np.random.default_rng([seed, n])
    images = rng.integers(0, 256, (n, 3750)).astype(np.uint8)
    images[:, :14] = 0
    images[:, 14] = (1 << rng.integers(0, 9, n)) - 1
    return images.reshape(n, 50, 75)


@contextlib.contextmanager
def bench(**config: Any) -> Iterator[Bench]:
    with tempfile.TemporaryDirectory() as folder:
        made = Bench(Path(folder) / "replay", **config)
        try:
            yield made
        finally:
            made.storage.close()


events = st.lists(
    st.one_of(
        st.tuples(st.just("episode"), st.integers(1, 25)),
        st.tuples(st.sampled_from(["reopen", "new weights", "mirror", "two commits"]), st.just(0)),
    ),
    min_size=8,
    max_size=30,
)


@SLOW_DISK
@given(
    given_events=events,
    strategy=st.sampled_from(["rmm", "rmm", "normm"]),
    rule=st.sampled_from(["paper", "cover"]),
    fill=st.sampled_from(["random", "none"]),
    growth=st.sampled_from([(0, 0), (60, 0), (60, 20)]),
    decree=st.sampled_from([0, 2, 4]),
)
def test_disk_memory_and_mirror_hold_what_the_rules_say_over_restarts(
    given_events: list[tuple[str, int]],
    strategy: str,
    rule: str,
    fill: str,
    growth: tuple[int, int],
    decree: int,
) -> None:
    with bench(
        strategy=strategy,
        rule=rule,
        fill=fill,
        capacity_max=growth[0],
        capacity_step=growth[1],
        mark_all_at_episode=decree,
    ) as b:
        mirror, at = SampleStore(), 0
        for number, (event, n) in enumerate(given_events):
            if event == "reopen":
                b.reopen()
            elif event == "new weights":
                b.version += 1
            elif event == "mirror":
                parts, end = pulled(b.storage.feed.changes(at, b.change, b.lineages[at]))
                assert (end.change, end.gone) == (b.change, False)
                assert end.lineage == b.lineages[b.change]
                for part in parts:
                    apply(mirror, part)
                    if part.last:
                        same_samples(mirror, b.seen[part.number])
                at = end.change
                mirror.check_valid()
            else:
                for part in range(2 if event == "two commits" else 1):
                    filling = fill == "random" and b.filled < b.config.capacity
                    size = n or 3
                    world = ("plus", "minus")[number % 2]
                    images = some_images(size, number)
                    life = f"{part:012x}"
                    b.commit(
                        make_episode(
                            size,
                            seed=number,
                            images=images,
                            fill=filling,
                            worlds=(world,),
                            life=life,
                            last_sequence=10_000 * (2 * number + part) + size,
                        )
                    )
                if event == "two commits":
                    b.reopen()  # killed between the commit and its turn
            while b.turn():
                b.check()
        b.reopen()
        b.check()
        parts, end = pulled(b.storage.feed.snapshot())
        snapshot = SampleStore()
        for part in parts:
            apply(snapshot, part)
        assert (end.change, end.lineage) == (b.change, b.lineages[b.change])
        same_samples(snapshot, b.seen[b.change])


# ------------------------------------------------------------------------- submissions


def test_a_repeated_submission_is_recognised_even_after_a_restart() -> None:
    with bench() as b:
        first = b.storage.commit(make_episode(5, seed=3))
        other = b.storage.commit(make_episode(6, seed=4))
        for _ in range(2):
            again = b.storage.commit(make_episode(5, seed=3))
            assert (again.duplicate, again.commit) == (True, first.commit)
            assert again.counters == other.counters
            b.reopen()
        assert b.storage.counters().commit == 2


@pytest.mark.parametrize("other", [{"robot": "robot2"}, {"life": "d" * 12}, {"number": 9}])
def test_another_robot_life_or_number_is_another_submission(other: dict[str, Any]) -> None:
    with bench() as b:
        b.storage.commit(make_episode(5, seed=3))
        second = make_episode(5, seed=3, last_sequence=40_000, **other)
        assert not b.storage.commit(second).duplicate


def test_a_refused_submission_leaves_no_trace() -> None:
    with bench(fill="random") as b:
        with pytest.raises(ValueError, match="being filled"):
            b.storage.commit(make_episode(5))
        assert b.storage.counters().commit == 0
        assert b.storage.pending(0) is None
        assert not b.storage.commit(make_episode(5, fill=True)).duplicate


def test_the_memory_starts_with_exactly_n_samples() -> None:
    with bench(fill="random") as b:
        for seed in range(5):
            images = some_images(13, seed)
            b.commit(make_episode(13, seed=seed, images=images, fill=True, robot=f"robot{seed}"))
            assert b.turn()
            b.check()
        assert len(b.memory) == 30
        assert b.storage.turns(0, 10) == ()


def test_a_turn_is_done_again_after_a_kill_between_commit_and_turn() -> None:
    with bench() as b:
        b.commit(make_episode(20, seed=1, images=some_images(20, 1)))
        b.turn()
        b.commit(make_episode(20, seed=2, images=some_images(20, 2)))
        b.reopen()
        assert len(b.memory) == 20
        assert len(b.storage.load()) == 20  # what is not applied is not in the memory
        assert b.turn()
        assert not b.turn()
        b.check()


def test_a_turn_that_was_begun_but_not_applied_leaves_nothing_behind() -> None:
    with bench() as b:
        b.commit(make_episode(31, seed=1, images=some_images(31, 1)))
        pending = b.storage.pending(0)
        assert pending is not None
        memory = b.storage.load()
        memory.append(pending.rows, pending.images)
        predictor: Any = FakePredictor(1)
        maintain(memory, Moment(1), b.config, predictor, seed=1)
        b.reopen()  # killed here
        assert b.turn()
        b.check()


def test_marks_by_decree_are_on_disk_at_once_and_set_only_once() -> None:
    """A44: they do not wait for the next recomputation, and stay until the samples go."""
    with bench(mark_all_at_episode=2) as b:
        marked = []
        for seed in range(4):
            b.commit(make_episode(5, seed=seed, images=some_images(5, seed)))
            b.turn()
            b.check()
            b.reopen()
            marked.append(b.memory.ids[b.memory.rows["forced"]].tolist())
        assert marked == [[], *[[1, 2, 3, 4, 5]] * 3]
        assert b.memory.rows["candidate"].tolist() == b.memory.rows["forced"].tolist()


def test_samples_that_filled_the_memory_are_marked_by_decree_too() -> None:
    with bench(fill="random", mark_all_at_episode=1) as b:
        b.commit(make_episode(30, seed=1, fill=True))
        b.turn()
        assert not b.memory.rows["forced"].any()
        b.commit(make_episode(9, seed=2))
        b.turn()
        b.check()
        assert b.memory.ids[-9:].tolist() == list(range(31, 40))
        assert b.memory.rows["forced"].tolist() == (b.memory.ids <= 30).tolist()


def test_a_grown_capacity_survives_a_restart() -> None:
    with bench(capacity_max=60, capacity_step=10) as b:
        noise = np.random.default_rng(1).integers(0, 256, (31, 50, 75)).astype(np.uint8)
        b.commit(make_episode(31, seed=1, images=noise))
        b.turn()
        assert (b.memory.capacity, len(b.memory)) == (40, 31)
        b.reopen()
        b.check()
        assert b.memory.capacity == b.storage.position().capacity == 40


def test_rows_carry_their_provenance_to_disk_and_back() -> None:
    with bench() as b:
        episode = make_episode(
            4, seed=2, worlds=("plus", "minus"), sample_worlds=b"\x01\x00\x01\x01"
        )
        b.commit(make_episode(1, seed=1, worlds=("i16c",)))
        b.commit(episode)
        while b.turn():
            pass
        loaded = b.storage.load()
        rows = loaded.rows[1:]
        assert [loaded.worlds[w] for w in rows["world"]] == ["minus", "plus", "minus", "minus"]
        assert rows["commit"].tolist() == [2] * 4
        assert rows["episode"].tolist() == [2] * 4
        assert rows["step"].tolist() == [0, 1, 2, 3]
        assert rows["robot_episode"].tolist() == [2] * 4
        assert rows["version"].tolist() == [1] * 4
        places = np.frombuffer(episode.positions, "<f4").reshape(4, 3)
        assert rows["x_m"].tolist() == places[:, 0].tolist()
        assert rows["y_m"].tolist() == places[:, 1].tolist()
        assert rows["heading_rad"].tolist() == places[:, 2].tolist()
        assert rows["reward"].tobytes() == episode.sample_rewards
        assert rows["action"].tobytes() == episode.sample_actions


def test_records_and_turns_list_counted_episodes_in_order() -> None:
    with bench(fill="random") as b:
        b.commit(make_episode(30, seed=0, images=some_images(30, 0), fill=True))
        for seed in range(1, 6):
            ended = "bump" if seed % 2 else "full"
            b.commit(make_episode(seed, seed=seed, images=some_images(seed, seed), ended=ended))
        while b.turn():
            pass
        assert [r["commit"]["episode"] for r in b.storage.records()] == [0, 1, 2, 3, 4, 5]
        assert [r["fitness"] for r in b.storage.records()] == [30, 1, 2, 3, 4, 5]
        turns = b.storage.turns(0, 100)
        assert [(t.episode, t.bump, t.samples, t.actions) for t in turns] == [
            (n, bool(n % 2), n, n) for n in range(1, 6)
        ]
        assert [t.episode for t in b.storage.turns(2, 2)] == [3, 4]
        assert b.storage.turns(5, 10) == ()
        assert turns[-1].change == b.storage.position().turn_change == b.change


# ------------------------------------------------------------------------- identity


def test_files_of_another_run_are_refused(tmp_path: Path) -> None:
    config = MemoryConfig(capacity=30)
    Storage(tmp_path, config, "run1/one").close()
    with pytest.raises(StateError, match="another run folder"):
        Storage(tmp_path, config, "run1/two")
    Storage(tmp_path, config, "run1/one").close()


def test_files_of_another_schema_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = MemoryConfig(capacity=30)
    Storage(tmp_path, config, IDENTITY).close()
    monkeypatch.setattr("services.replay.tables.SCHEMA", 999)
    with pytest.raises(StateError, match="999"):
        Storage(tmp_path, config, IDENTITY)


def test_looking_where_no_memory_is_creates_none(tmp_path: Path) -> None:
    for folder in (tmp_path / "none", tmp_path):
        with pytest.raises(StateError, match="expected a replay memory, found none"):
            Tables(folder, readonly=True)
    assert not list(tmp_path.iterdir())


def test_a_missing_image_is_told_and_not_made_up() -> None:
    with bench() as b:
        b.commit(make_episode(3))
        b.turn()
        with b.storage._tables.env.begin(write=True) as txn:
            txn.delete((2).to_bytes(8, "big"), db=b.storage._tables.db["images"])
        with pytest.raises(StateError, match="1 of 3 missing"):
            b.storage.load()


# ------------------------------------------------------------------------- the feed


def test_a_large_episode_comes_in_parts_of_one_change() -> None:
    with bench(capacity=2000) as b:
        b.commit(make_episode(600, seed=1, images=some_images(600, 1)))
        b.turn()
        parts, _ = pulled(b.storage.feed.changes(0, 1, NO_LINEAGE))
        assert [len(p.ids) // 8 for p in parts] == [256, 256, 88]
        assert [p.last for p in parts] == [False, False, True]
        assert {p.number for p in parts} == {1}
        snapshot, _ = pulled(b.storage.feed.snapshot())
        assert [p.last for p in snapshot] == [False, False, True]


def test_nothing_new_and_nothing_at_all() -> None:
    with bench() as b:
        parts, end = pulled(b.storage.feed.changes(0, 0, NO_LINEAGE))
        assert (parts, end.change, end.gone) == ([], 0, False)
        parts, end = pulled(b.storage.feed.snapshot())
        assert (parts, end.change) == ([], 0)
        b.commit(make_episode(3))
        b.turn()
        parts, end = pulled(b.storage.feed.changes(1, 1, b.lineages[1]))
        assert (parts, end.change, end.gone) == ([], 1, False)


def test_asking_beyond_the_newest_change_gives_the_newest() -> None:
    with bench() as b:
        b.commit(make_episode(3))
        b.turn()
        parts, end = pulled(b.storage.feed.changes(0, 99, NO_LINEAGE))
        assert (len(parts), end.change) == (1, 1)
        assert pulled(b.storage.feed.changes(5, 9, b.lineages[1]))[
            1
        ].gone  # a mirror of another life of this run


def test_forgotten_changes_are_gone_and_their_samples_deleted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(feed_module, "CHANGES_KEPT", 6)
    with bench(strategy="normm", equalise_every=0) as b:
        for seed in range(12):
            b.commit(make_episode(16, seed=seed, images=some_images(16, seed)))
            b.turn()
            b.check()
        newest = b.change
        for since in range(newest + 1):
            parts, end = pulled(b.storage.feed.changes(since, newest, b.lineages[since]))
            assert end.gone == (since < newest - 6)
            if not end.gone:
                mirror = SampleStore()
                snapshot_of(b, since, mirror)
                for part in parts:
                    apply(mirror, part)
                same_samples(mirror, b.seen[newest])
        with b.storage._tables.env.begin() as txn:
            held = txn.stat(b.storage._tables.db["images"])["entries"]
            assert held == txn.stat(b.storage._tables.db["samples"])["entries"]
            assert held == len(b.memory) + txn.stat(b.storage._tables.db["dead"])["entries"]
        assert held < 12 * 16
        b.reopen()
        b.check()


def snapshot_of(b: Bench, number: int, mirror: SampleStore) -> None:
    """Bring a mirror to an earlier change, as if it had followed."""
    for ident, action, reward, image in b.seen[number]:
        row = np.zeros(1, mirror.rows.dtype)
        row["id"], row["action"], row["reward"] = ident, action, reward
        mirror.append(row, np.frombuffer(image, np.uint8).reshape(1, 50, 75))


def test_a_mini_batch_for_a_foreign_learner_has_current_rewards() -> None:
    with bench(equalise_every=1) as b:
        for seed in range(3):
            b.commit(make_episode(20, seed=seed, images=some_images(20, seed)))
            b.turn()
        batch = b.storage.feed.mini_batch(8, generator(1, "test", 1))
        assert batch == b.storage.feed.mini_batch(8, generator(1, "test", 1))
        ids = np.frombuffer(batch.ids, "<u8").tolist()
        assert len(ids) == len(set(ids)) == 8
        ranks = b.memory.ranks(np.array(ids, np.uint64))
        assert batch.rewards == b.memory.rows["reward"][ranks].tobytes()
        assert batch.images == b.memory.images(ranks).tobytes()
        assert len(b.storage.feed.mini_batch(999, generator(1, "test", 2)).ids) // 8 == len(
            b.memory
        )
        b.commit(make_episode(20, seed=3, images=some_images(20, 3)))
        b.turn()
        later = b.storage.feed.mini_batch(999, generator(1, "test", 2))
        assert np.frombuffer(later.ids, "<u8").tolist() == b.memory.ids.tolist()


# ------------------------------------------------------------------------- the mirror


class ScriptedBus:
    """Answers a mirror from a storage, or as told."""

    def __init__(self, bench_: Bench) -> None:
        self.bench = bench_
        self.asked: list[str] = []
        self.lost: int | None = None
        """Place of a reply that does not arrive."""

    def request_many(self, stream: Any, request: Any, *types: Any, **_: Any) -> Any:
        self.asked.append(stream.name)
        storage = self.bench.storage
        if stream is CHANGES:
            replies = list(storage.feed.changes(request.since, request.upto, request.lineage))
        else:
            replies = list(storage.feed.snapshot())
        if self.lost is not None:
            del replies[self.lost]
        yield from replies


def test_a_mirror_follows_change_by_change_and_resynchronises_after_a_gap(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(feed_module, "CHANGES_KEPT", 4)
    with bench() as b:
        mirror, bus = Mirror(), ScriptedBus(b)
        any_bus: Any = bus
        for seed in range(9):
            b.commit(make_episode(15, seed=seed, images=some_images(15, seed)))
            b.turn()
            b.check()
            if seed not in (5, 6, 7):
                mirror.reach(any_bus, b.change, b.lineages[b.change])
                assert mirror.number == b.change
                same_samples(mirror.samples, b.seen[b.change])
        assert bus.asked == ["snapshot"] + ["changes"] * 5 + ["snapshot"]
        assert mirror.resyncs == 1
        mirror.reach(any_bus, b.change - 1, b.lineages[b.change - 1])
        assert len(bus.asked) == 7


def test_a_memory_of_five_million_samples_comes_over_a_slow_radio(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At 20 Mbit/s: two hours and a half, in which the learner shows that it lives."""
    rows, clock, beats, taken = 5_000_000, [0.0], [0.0], []
    part_s = feed_module.PART_ROWS * 3780 * 8 / 20e6
    some = SimpleNamespace(count=feed_module.PART_ROWS)
    monkeypatch.setattr(mirror_module, "Change", SimpleNamespace)
    monkeypatch.setattr(mirror_module, "_take", lambda _, part: taken.append(part.count))

    class Radio:
        def request_many(self, *_: Any, patience_s: float) -> Any:
            while len(taken) * some.count < rows:
                clock[0] += part_s
                assert part_s < patience_s
                yield some
            yield FeedEnd(change=7, rows=sum(taken), messages=len(taken), lineage=NO_LINEAGE)

    mirror, radio = Mirror(), Radio()
    mirror.reach(radio, 7, NO_LINEAGE, lambda: beats.append(clock[0]))  # type: ignore[arg-type]
    assert mirror.number == 7
    assert clock[0] > 7000
    assert max(b - a for a, b in itertools.pairwise(beats)) < 1.0


@pytest.mark.parametrize("lost", [0, -1])
def test_a_broken_transfer_leaves_the_mirror_at_a_complete_change(lost: int) -> None:
    with bench() as b:
        mirror, bus = Mirror(), ScriptedBus(b)
        any_bus: Any = bus
        b.commit(make_episode(15, seed=1, images=some_images(15, 1)))
        b.turn()
        bus.lost = lost
        with pytest.raises(PeerSilent):
            mirror.reach(any_bus, b.change, b.lineages[b.change])
        assert mirror.number is None
        bus.lost = None
        mirror.reach(any_bus, b.change, b.lineages[b.change])
        standing = b.change
        b.commit(make_episode(20, seed=2, images=some_images(20, 2)))
        b.turn()
        bus.lost = lost
        with pytest.raises(PeerSilent):
            mirror.reach(any_bus, b.change, b.lineages[b.change])
        assert mirror.number == standing
        same_samples(mirror.samples, b.seen[standing])


# ------------------------------------------------------------------------- no room


def test_on_a_full_disk_nothing_is_lost_and_it_goes_on_when_there_is_room(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with bench() as b:
        b.commit(make_episode(15, seed=1, images=some_images(15, 1)))
        b.turn()
        before = b.storage.counters()
        with monkeypatch.context() as full:
            full.setattr(Storage, "_write_samples", raising(lmdb.DiskError("no space left")))
            full.setattr(tables_module.shutil, "disk_usage", lambda _: SimpleNamespace(free=0))
            with pytest.raises(DiskFull, match="disk full: "):
                b.storage.commit(make_episode(15, seed=2))
        assert b.storage.counters() == before
        b.commit(make_episode(15, seed=2, images=some_images(15, 2)))
        b.turn()
        b.check()


def raising(error: Exception) -> Any:
    def fail(*_: Any, **__: Any) -> None:
        raise error

    return fail


def test_without_address_space_it_says_in_one_line_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lmdb, "open", raising(lmdb.MemoryError("cannot allocate memory")))
    with pytest.raises(ConfigError, match=r"256 GB of address space.*`ulimit -v unlimited`"):
        Storage(tmp_path, MemoryConfig(), IDENTITY)
