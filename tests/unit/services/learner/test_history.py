"""A learner trains on the history that its checkpoint is of, and on no other."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from builders import FakePredictor, make_config, make_episode
from fakes import message

from services.learner.history import Place
from services.learner.service import LAST_TAKEOVER, LearnerLoop
from services.replay.storage import Storage
from shared.errors import BadMessage, PeerSilent, StateError
from shared.keys import CHANGES, LEARNER_STATE, SNAPSHOT
from shared.messages import LearnerState, ReplayState, Turn, Turns
from shared.rl.schedule import Moment
from shared.rl.turn import maintain
from shared.service import StopFlag, Stopped

CONFIG = make_config(
    memory={"capacity": 40, "fill": "none"},
    learning={"batch_size": 4, "mini_batches_per_episode": 1, "target_rule": "episode"},
    numerics={"learner": {"threads": 1, "device": "cpu", "precision": "float32"}},
)


def turn(episode: int, lineage: str = "a" * 16) -> Turn:
    return message(Turn, episode=episode, lineage=lineage)


# ------------------------------------------------------------------------- where it stands


def test_the_turns_after_the_newest_one_done_follow() -> None:
    place = Place(3, "a" * 16)
    assert place.since == 2
    assert place.next_turns([turn(3), turn(4), turn(5)], "it") == (turn(4), turn(5))
    assert place.next_turns([turn(3)], "it") == ()
    assert Place().since == 0
    assert Place().next_turns([turn(1), turn(2)], "it") == (turn(1), turn(2))
    assert Place().next_turns([], "it") == ()


@pytest.mark.parametrize("turns", [[], [turn(4)], [turn(2)]])
def test_a_memory_that_is_behind_the_checkpoint_is_refused(turns: list[Turn]) -> None:
    with pytest.raises(StateError, match="replay has no turn 3, but the checkpoint it is of that"):
        Place(3, "a" * 16).next_turns(turns, "it")


@pytest.mark.parametrize("known", ["b" * 16, ""])
def test_a_memory_of_another_history_is_refused(known: str) -> None:
    with pytest.raises(StateError, match=r"turn 3 has lineage a{16}, .* move the checkpoint away"):
        Place(3, known).next_turns([turn(3), turn(4)], "it")


@pytest.mark.parametrize("turns", [[turn(3), turn(5)], [turn(3), turn(3)], [turn(3), turn(4)] * 2])
def test_turns_that_are_out_of_order_are_none(turns: list[Turn]) -> None:
    assert Place(3, "a" * 16).next_turns(turns, "it") == ()


# ------------------------------------------------------------------------- the whole loop


class Replay:
    """A bus with a real memory behind it, whose turns are done at once."""

    def __init__(self, folder: Path) -> None:
        self.storage = Storage(folder, CONFIG.memory, "run/1")
        self._memory = self.storage.load()
        self.known_version = 1
        self.announced: list[LearnerState] = []
        self.lies: list[Any] = []
        """Told in place of true answers and heartbeats, each once."""

    def store(self, *seeds: int) -> None:
        predictor: Any = FakePredictor()
        for seed in seeds:
            self.storage.commit(make_episode(6, seed=seed))
            pending = self.storage.pending(self.storage.position().processed)
            assert pending is not None
            self._memory.append(pending.rows, pending.images)
            now = Moment(pending.commit.episode)
            done = maintain(self._memory, now, CONFIG.memory, predictor, seed=1)
            self.storage.apply_turn(pending, self._memory, done)

    def _lie(self, cls: type[Any]) -> Any:
        found = next((lie for lie in self.lies if isinstance(lie, cls)), None)
        if found is not None:
            self.lies.remove(found)
        return found

    # what a learner does with its bus and its inbox

    def publish(self, stream: Any, state: Any) -> None:
        assert stream is LEARNER_STATE
        self.announced.append(state)

    def request(self, _: Any, request: Any, cls: Any) -> Turns:
        lie = self._lie((Turns, Exception))  # type: ignore[arg-type]
        if isinstance(lie, Exception):
            raise lie
        return lie or Turns(turns=self.storage.turns(request.since, request.limit))

    def request_many(self, stream: Any, request: Any, *_: Any, **__: Any) -> Any:
        feed = self.storage.feed
        if stream is CHANGES:
            return feed.changes(request.since, request.upto, request.lineage)
        assert stream is SNAPSHOT
        return feed.snapshot()

    def inbox(self) -> Any:
        return SimpleNamespace(
            subscribe=lambda *_: None,
            serve=lambda *_: None,
            requests=lambda: iter(()),
            wake=lambda: None,
            wait=lambda _: None,
            take=lambda *_: [("main", self._lie(ReplayState) or self.state())],
            refused=Counter(),
        )

    def state(self, **given: Any) -> ReplayState:
        position = self.storage.position()
        plain = {
            "turn": position.turn,
            "turn_change": position.turn_change,
            "lineage": position.turn_lineage,
            "known_version": self.known_version,
            "by_action": (0, 0, 0),
        }
        return message(ReplayState, **{**plain, **given})


class Learner:
    """A learner in a folder, run until it has come to an episode."""

    def __init__(self, folder: Path, replay: Replay) -> None:
        self.folder, self.replay = folder, replay

    def until(self, reached: Callable[[LearnerState], bool]) -> LearnerState:
        """Start, go on until a heartbeat is as wanted, and stop."""
        stop, states = StopFlag(), self.replay.announced
        states.clear()

        def insist(what: str, attempt: Callable[[], Any]) -> Any:
            for _ in range(5):
                try:
                    return attempt()
                except (PeerSilent, BadMessage):
                    if states and reached(states[-1]):
                        raise Stopped(what) from None
            raise AssertionError(f"no answer: {what}")

        def publish(stream: Any, state: LearnerState) -> None:
            Replay.publish(self.replay, stream, state)
            if reached(state):
                stop.set("reached")
            assert len(states) < 200, "never reached"

        bus = SimpleNamespace(
            publish=publish,
            request=self.replay.request,
            request_many=self.replay.request_many,
            inbox=self.replay.inbox,
        )
        me: Any = SimpleNamespace(
            config=CONFIG.model_copy(
                update={"bus": CONFIG.bus.model_copy(update={"heartbeat_s": 0.0})}
            ),
            bus=bus,
            stop=stop,
            life="0" * 12,
            log=logging.getLogger("learner"),
            insist=insist,
        )
        LearnerLoop(me, self.folder).run()
        return states[-1]

    def come_to(self, episode: int) -> LearnerState:
        return self.until(lambda state: state.episode == episode)

    @property
    def checkpoint(self) -> Path:
        return self.folder / "learner" / "checkpoint.safetensors"


@pytest.fixture
def learner(tmp_path: Path) -> Iterator[Learner]:
    made = Learner(tmp_path / "run", Replay(tmp_path / "replay"))
    yield made
    made.replay.storage.close()


def test_a_learner_goes_on_where_its_checkpoint_is(learner: Learner) -> None:
    learner.replay.store(1, 2, 3)
    assert learner.come_to(3).weights_version == 4
    learner.replay.store(4)
    assert learner.come_to(4).weights_version == 5


def test_a_learner_refuses_a_memory_that_was_restored_and_went_on(
    learner: Learner, tmp_path: Path
) -> None:
    learner.replay.store(1, 2, 3)
    learner.come_to(3)
    before = learner.checkpoint.read_bytes()
    other = Replay(tmp_path / "other")
    other.store(1, 2)
    learner.replay, first = other, learner.replay
    with pytest.raises(StateError, match="replay has no turn 3"):
        learner.come_to(4)
    other.store(13, 14)
    with pytest.raises(StateError, match="the memory has another history: restore memory and"):
        learner.come_to(4)
    assert learner.checkpoint.read_bytes() == before
    learner.replay = first
    other.storage.close()


def test_a_learner_that_lost_its_checkpoint_goes_on_above_what_others_have(
    learner: Learner, caplog: pytest.LogCaptureFixture
) -> None:
    learner.replay.store(1, 2, 3)
    learner.replay.known_version = learner.come_to(3).weights_version
    learner.come_to(3)
    assert "it goes on as version" not in caplog.text
    learner.checkpoint.unlink()
    again = learner.come_to(3)
    assert again.weights_version == 4 + 2 + 3
    assert "weights version 4 is known to replay, this learner has come to 1 only" in caplog.text
    versions = [s.weights_version for s in learner.replay.announced]
    assert versions == sorted(versions)


def test_nobody_moves_the_versions_of_a_learner_at_work(learner: Learner) -> None:
    learner.replay.store(1, 2)
    learner.replay.lies = [learner.replay.state(known_version=LAST_TAKEOVER)]
    assert learner.come_to(2).weights_version == 3
    learner.replay.store(3)

    def wanted(state: LearnerState) -> bool:
        if state.episode == 3:
            learner.replay.known_version = 1000
        return state.episode == 3 and len(learner.replay.announced) > 40

    assert learner.until(wanted).weights_version == 4


def test_forged_announcements_and_answers_end_no_learner(learner: Learner) -> None:
    replay = learner.replay
    replay.store(1, 2)
    learner.come_to(2)
    replay.store(3)
    known = replay.storage.turns(1, 2)
    replay.lies = [
        replay.state(turn=2**62, turn_change=0),
        replay.state(turn=0),
        replay.state(turn=2, lineage="f" * 16),
        Turns(turns=(known[0], turn(9))),
        Turns(turns=(known[0], known[1].model_copy(update={"lineage": "f" * 16}))),
        BadMessage("no message"),
        Turns(turns=(known[0], known[1].model_copy(update={"change": 2**40}))),
    ]
    assert learner.come_to(3).weights_version == 4
    assert replay.lies == []


def test_a_state_that_is_not_finite_ends_the_learner_and_leaves_the_checkpoint(
    learner: Learner, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner.replay.store(1)
    learner.come_to(1)
    before = learner.checkpoint.read_bytes()

    def spoil(trainer: Any, *_: Any) -> bool:
        trainer.target_network.out.bias.data[0] = float("nan")
        trainer.version += 1
        return True

    monkeypatch.setattr("shared.rl.learning.Trainer.apply_target_rule", spoil)
    learner.replay.store(2)
    with pytest.raises(StateError, match=r"episode 2: not published: .*out\.bias.*is of the epis"):
        learner.come_to(2)
    assert learner.checkpoint.read_bytes() == before
    assert list(learner.checkpoint.parent.iterdir()) == [learner.checkpoint]
    assert max(state.weights_version for state in learner.replay.announced) == 2
