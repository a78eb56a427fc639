"""One robot at the actor: what it is answered while its last episode is on its way."""

from __future__ import annotations

import logging
from concurrent.futures import Future
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builders import FakePredictor, make_config, make_observation

from services.actor.courier import Delivery
from services.actor.heard import Newest
from services.actor.service import ActorLoop
from services.actor.session import Session
from shared.messages import (
    Action,
    Episode,
    EpisodeAck,
    LearnerState,
    RobotProgress,
    Takeover,
    image_array,
)

LEARNER = LearnerState(
    id="main",
    life="0123456789ab",
    episode=5,
    weights_version=1,
    weights_hash="0" * 16,
    activity="waiting",
    loss=None,
    train_steps=0,
    fits=0,
    target_age=0,
    resyncs=0,
    undecodable=0,
)


def progress(episodes: int) -> RobotProgress:
    return RobotProgress(
        robot="robot1",
        filling=False,
        fill_missing=0,
        robot_fills=0,
        robot_episodes=episodes,
        episode=episodes,
        robot_life="",
        last_sequence=-1,
    )


class Rig:
    """A session whose episodes are delivered when a test says so."""

    def __init__(self, timing: str, folder: Path, **given: Any) -> None:
        self.published: list[Action] = []
        self.sent: list[Episode] = []
        self.on_its_way: Future[Delivery] = Future()
        me = SimpleNamespace(
            ident="main",
            stop=Event(),
            config=make_config(robot={"timing": timing}, **given),
            log=logging.getLogger("actor"),
            bus=SimpleNamespace(publish=lambda _, action, __: self.published.append(action)),
        )
        predictor = FakePredictor()
        targets = SimpleNamespace(none=FakePredictor(version=0), of=lambda *_: predictor)
        weights = SimpleNamespace(newest=(1, b""), refused=0)
        asked: Future[RobotProgress] = Future()
        asked.set_result(progress(0))
        courier = SimpleNamespace(send=self._send, ask=lambda _: asked)
        newest = Newest(LEARNER)
        path = folder / "robot1.msgpack"
        parts: tuple[Any, ...] = (
            me,
            "robot1",
            "c" * 12,
            path,
            newest,
            weights,
            targets,
            courier,
            set,
        )
        self.session = Session(*parts)

    def _send(self, episode: Episode) -> Future[Delivery]:
        self.sent.append(episode)
        return self.on_its_way

    def see(self, sequence: int, **given: Any) -> None:
        """Let an observation come, and answer it if it may be answered."""
        if sequence:
            done = next(a for a in self.published if a.sequence == sequence - 1)
            given = {"action": done.action, "actor_life": done.actor_life, **given}
        self.session.offer(make_observation(sequence, **given))
        waiting = self.session.advance()
        if waiting is not None:
            image = image_array(waiting.image)
            values = self.session.actor.predictor.all_values(image[np.newaxis])[0]
            self.session.answer(waiting, values)


@pytest.mark.parametrize("timing", ["lockstep", "realtime"])
def test_a_robot_is_held_while_its_episode_is_on_its_way(timing: str, tmp_path: Path) -> None:
    rig = Rig(timing, tmp_path)
    rig.see(0)
    assert rig.published[-1].action is not None
    rig.see(1, bump=True)
    rig.see(1, bump=True, attempt=1)
    held = rig.published[1:]
    if timing == "lockstep":  # simulated time stands still: there is nothing to say
        assert held == []
    else:
        assert [(a.action, a.sequence, a.attempt) for a in held] == [(None, 1, 0), (None, 1, 1)]
    ack = EpisodeAck(accepted=True, commit=1, episode=1, stored=1, progress=progress(1))
    rig.on_its_way.set_result(Delivery(ack, attempts=1))
    rig.see(1, bump=True, attempt=2)
    assert rig.published[-1].action is not None
    assert rig.published[-1].attempt == 2
    assert rig.session.actor.dropped_samples == 0


def test_the_episodes_of_a_life_are_numbered_from_0_whatever_it_took_over(tmp_path: Path) -> None:
    before = Rig("lockstep", tmp_path)
    before.see(0)
    before.see(1, bump=True)
    before.session.save()  # a clean stop, while the episode is on its way
    after = Rig("lockstep", tmp_path)
    after.published += before.published
    ack = EpisodeAck(accepted=True, commit=1, episode=1, stored=1, progress=progress(1))
    after.on_its_way.set_result(Delivery(ack, attempts=1))
    after.see(1, bump=True)
    after.see(2, bump=True)
    lives = [before.session.actor.life, after.session.actor.life]
    assert [(episode.life, episode.number) for episode in after.sent] == [
        (lives[0], 0),
        (lives[1], 0),
    ]


@pytest.mark.parametrize(
    ("given", "left"),
    [
        ({"a": (9.0, 1), "b": (70.0, 0), "c": (5.0, 0)}, "ac"),  # the longest gone
        ({"a": (9.0, 1), "b": (70.0, 1), "c": (5.0, 0)}, "ab"),  # whose driver is not there
        ({"a": (0.0, 0), "b": (0.0, 0)}, "ab"),  # all are heard, or owe an episode
    ],
)
def test_the_robot_that_is_gone_for_longest_makes_room(
    given: dict[str, tuple[float, int]], left: str
) -> None:
    saved: list[str] = []
    sessions = {
        robot: SimpleNamespace(idle_s=idle_s, save=lambda robot=robot: saved.append(robot))
        for robot, (idle_s, _) in given.items()
    }
    inbox = SimpleNamespace(lives=lambda _, robot: set(range(given[robot][1])))
    loop: Any = SimpleNamespace(_sessions=sessions, _inbox=inbox)
    ActorLoop._forget_one(loop)
    assert "".join(sessions) == left
    assert set(saved) == set(given) - set(left)  # it goes on where it was if it comes back


def test_a_robot_that_owes_an_episode_is_not_put_away(tmp_path: Path) -> None:
    rig = Rig("lockstep", tmp_path)
    rig.see(0)
    assert rig.session.idle_s == 0.0
    rig.session._served.heard_s -= 60.0
    assert rig.session.idle_s >= 60.0
    rig.session._pending = SimpleNamespace()  # type: ignore[assignment]
    assert rig.session.idle_s == 0.0


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    now = SimpleNamespace(s=100.0)
    monkeypatch.setattr("services.actor.session.time.monotonic", lambda: now.s)
    return now


def takeover(rig: Rig, number: int, action: int | None, now_s: float, **given: Any) -> None:
    wish = Takeover(robot="robot1", life="9" * 12, number=number, action=action, **given)
    rig.session.hand.note(wish, now_s)


def driven(rig: Rig) -> list[tuple[int | None, str]]:
    return [(action.action, action.by) for action in rig.published]


def test_in_lockstep_a_person_drives_no_faster_than_real_time(
    clock: SimpleNamespace, tmp_path: Path
) -> None:
    rig = Rig("lockstep", tmp_path)
    takeover(rig, 1, None, clock.s)
    rig.see(0)
    assert rig.published == []
    takeover(rig, 2, 2, clock.s)
    rig.see(0)
    rig.see(1)
    assert driven(rig) == [(2, "human")]
    clock.s += 0.25
    takeover(rig, 3, 1, clock.s)
    rig.see(1)
    assert driven(rig) == [(2, "human"), (1, "human")]
    clock.s += 0.4  # they let go, or are gone
    rig.see(2)
    assert len(rig.published) == 2
    assert rig.session.heartbeat(0, 0).phase == "person"
    takeover(rig, 4, None, clock.s, give_back=True)
    rig.see(2)
    assert rig.published[-1].by != "human"
    assert rig.session.heartbeat(0, 0).human_actions == 2


def test_in_real_time_letting_go_stops_at_once_and_a_key_starts_within_the_period(
    clock: SimpleNamespace, tmp_path: Path
) -> None:
    rig = Rig("realtime", tmp_path)
    rig.see(0)
    takeover(rig, 1, None, clock.s)
    rig.see(1)
    assert driven(rig)[1:] == [(None, "network")]  # it moved: hold
    rig.see(1, attempt=1)
    assert len(rig.published) == 2  # it stands: there is time
    clock.s += 0.1
    takeover(rig, 2, 1, clock.s)
    rig.see(1, attempt=1)
    assert driven(rig)[2:] == [(1, "human")]
    clock.s += 0.4
    rig.see(2)
    rig.see(2, attempt=1)
    clock.s += 0.2
    rig.see(2, attempt=1)
    assert driven(rig)[3:] == [(None, "network"), (None, "network")]


def test_a_memory_that_a_person_is_to_fill_waits_for_one(
    clock: SimpleNamespace, tmp_path: Path
) -> None:
    rig = Rig("lockstep", tmp_path, memory={"fill": "human"})
    rig.session.actor.progress = progress(0).model_copy(update={"filling": True})
    rig.see(0)
    assert rig.published == []
    takeover(rig, 1, 0, clock.s)
    rig.see(0)
    assert [(a.action, a.by, a.filling) for a in rig.published] == [(0, "human", True)]
    takeover(rig, 2, None, clock.s, give_back=True)
    rig.see(1)
    assert len(rig.published) == 1
