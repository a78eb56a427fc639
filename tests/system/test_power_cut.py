"""State files and memories that come back from before: nothing is lost, doubled or stuck.

Driver, session, actor and memory are the real ones, with their files. The robot takes pictures that
nobody sees again, so a sample that is stored twice is found.
"""

from __future__ import annotations

import itertools
import logging
import shutil
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builders import FakePredictor, image_with, make_config
from fakes import message

from services.actor.courier import Delivery
from services.actor.heard import Newest
from services.actor.session import Session
from services.learner.history import Place
from services.replay.numbering import progress_of
from services.replay.storage import Refused, Storage
from services.robot_driver.driver import Driver
from services.robot_driver.robot import STANDSTILL, Felt, Pose, Robot, Sensed, Velocity
from shared import statefile
from shared.errors import StateError
from shared.messages import Action, Episode, EpisodeAck, LearnerState, image_array
from shared.rl.schedule import Moment
from shared.rl.turn import maintain
from shared.service import new_life

CONFIG = make_config(
    robot={"id": "robot1"},
    episode={"max_samples": 12, "horizon": 4},
    memory={"capacity": 2000, "fill": "none"},
    learning={"mode": "asynchronous"},
)
IDENTITY = "run/1"
LEARNER = message(LearnerState, episode=10**6, weights_version=1)
STEPS = 26
"""Actions between two stops."""
ENDS = ("between", "sent", "stored")
"""A stop with an open episode; with one on its way; with one stored and not acknowledged."""
pictures = itertools.count(1)


class Camera(Robot):
    """A robot that bumps now and then; its pictures are numbered."""

    def __init__(self) -> None:
        self.velocity, self.driven, self.picture = STANDSTILL, 0, next(pictures)

    def sense(self) -> Sensed:
        image = image_array(image_with(self.picture.to_bytes(4, "little")))
        return Sensed(self.feel().pose, False, image)

    def feel(self) -> Felt:
        return Felt(Pose(float(self.driven), 0.0, 0.0), contact=False)

    def drive(self, velocity: Velocity) -> None:
        self.velocity = velocity

    def run(self, duration_s: float, *, stop_on_contact: bool) -> bool:
        self.driven, self.picture = self.driven + 1, next(pictures)
        return stop_on_contact and self.driven % 9 == 0

    def now_s(self) -> float:
        return float(self.driven)

    def state(self) -> dict[str, Any]:
        return {"driven": self.driven}

    def restore(self, state: dict[str, Any]) -> None:
        self.driven = int(state["driven"])

    def close(self) -> None:
        self.velocity = STANDSTILL


class Site:
    """A run folder, and the processes that start from what lies there."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.driver_file, self.actor_file = folder / "state.msgpack", folder / "robot1.msgpack"
        self.storage = Storage(folder / "replay", CONFIG.memory, IDENTITY)
        self.end = ""
        """What happens to the next episode that is sent; empty: it is acknowledged."""
        self.acknowledged: list[str] = []
        self.start()

    def start(self) -> None:
        """Driver and actor as their services start them."""
        self.driver = Driver(CONFIG, Camera(), new_life())
        if (saved := statefile.take(self.driver_file)) is not None:
            self.driver.restore(saved)
        self.published: list[Action] = []
        me = SimpleNamespace(
            config=CONFIG,
            log=logging.getLogger("actor"),
            bus=SimpleNamespace(publish=lambda _, action, __: self.published.append(action)),
        )
        predictor: Any = FakePredictor()
        targets = SimpleNamespace(none=FakePredictor(version=0), of=lambda *_: predictor)
        weights = SimpleNamespace(newest=(1, b""), refused=0, wait_for=lambda _: (1, b""))
        courier = SimpleNamespace(send=self._send, ask=lambda robot: done(self._progress(robot)))
        place: tuple[Any, ...] = (me, "robot1", new_life(), self.actor_file)
        given: tuple[Any, ...] = (Newest(LEARNER), weights, targets, courier, set)
        self.session = Session(*place, *given)

    def _progress(self, robot: str) -> Any:
        return progress_of(self.storage.counters(), CONFIG.memory, robot)

    def _send(self, episode: Episode) -> Future[Delivery]:
        """What the courier does and replay answers."""
        if self.end == "sent":
            return Future()
        try:
            self.storage.commit(episode)
        except Refused as error:
            return done(Delivery(EpisodeAck(accepted=False, reason=str(error)), 1))
        if self.end == "stored":
            return Future()
        self.acknowledged.append(f"{episode.robot}/{episode.life}/{episode.number}")
        ack = EpisodeAck(accepted=True, progress=self._progress(episode.robot))
        return done(Delivery(ack, 1))

    def act(self, seen: dict[bytes, tuple[str, int]]) -> bool:
        """One observation and, if it is answered, one action; whether it was."""
        observation = self.driver.observe()
        seen[observation.image] = (observation.life, observation.sequence)
        self.session.offer(observation)
        for _ in range(3):  # a refused episode takes a further round
            if (waiting := self.session.advance()) is not None:
                values = FakePredictor().all_values(image_array(waiting.image)[np.newaxis])[0]
                self.session.answer(waiting, values)
                action = self.published[-1]
                assert self.driver.answers(action)
                assert action.action is not None
                self.driver.execute(action.action, action.actor_life)
                return True
        return False

    def stop(self, end: str, seen: dict[bytes, tuple[str, int]]) -> None:
        """Come to such an end, and save."""
        self.end = "" if end == "between" else end
        if self.end:
            assert any(not self.act(seen) for _ in range(2 * STEPS))
        self.session.save()
        statefile.save(self.driver_file, self.driver.saved())
        self.end = ""

    def turns(self) -> Place:
        """Do what replay has not done yet; where a learner is then."""
        memory, predictor = self.storage.load(), FakePredictor()
        while (new := self.storage.pending(self.storage.position().processed)) is not None:
            memory.worlds = new.worlds
            memory.append(new.rows, new.images)
            moment = Moment(new.commit.episode)
            kept = maintain(memory, moment, CONFIG.memory, predictor, seed=1)  # type: ignore[arg-type]
            self.storage.apply_turn(new, memory, kept)
        position = self.storage.position()
        return Place(position.turn, position.turn_lineage)

    def close(self) -> None:
        self.storage.close()


def done(result: Any) -> Future[Any]:
    future: Future[Any] = Future()
    future.set_result(result)
    return future


class History:
    """Stops in a row, and copies of all files as of each."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.seen: dict[bytes, tuple[str, int]] = {}
        self.acknowledged: list[int] = []
        """How many episodes were acknowledged by each stop."""
        site = Site(folder / "run")
        for number, end in enumerate(ENDS * 2):
            for _ in range(STEPS):
                assert site.act(self.seen)
            site.stop(end, self.seen)
            site.place = site.turns()
            site.close()
            shutil.copytree(site.folder, folder / f"point{number}")
            self.acknowledged.append(len(site.acknowledged))
            site.storage = Storage(site.folder / "replay", CONFIG.memory, IDENTITY)
            site.start()
        self.points = len(self.acknowledged)
        self.names = site.acknowledged
        self.place = site.turns()
        site.close()

    def put_back(self, into: Path, memory: int, driver: int | None, actor: int | None) -> Site:
        """Files as of several stops together; None: there is no such file."""
        shutil.copytree(self.folder / f"point{memory}" / "replay", into / "replay")
        for point, name in ((driver, "state.msgpack"), (actor, "robot1.msgpack")):
            if point is not None:
                shutil.copy(self.folder / f"point{point}" / name, into / name)
        return Site(into)

    def goes_on(self, site: Site, memory: int) -> None:
        """The robot drives on, and every sample is stored once."""
        before = len(site.storage.records())
        first = site.driver.sequence
        for _ in range(2 * STEPS):
            assert site.act(self.seen), "a robot waits for ever"
        assert site.driver.sequence == first + 2 * STEPS
        records = site.storage.records()
        assert len(records) >= before + 3
        assert site.session.refused_episodes <= 1
        names = [f"{r['robot']}/{r['life']}/{r['number']}" for r in records]
        assert len(names) == len(set(names))
        assert set(self.names[: self.acknowledged[memory]]) | set(site.acknowledged) <= set(names)
        places = [self.seen[image] for image in stored(site.storage)]
        assert len(places) == len(set(places)), "a sample is stored twice"


def stored(storage: Storage) -> Iterator[bytes]:
    """Images of all samples ever stored."""
    for commit in range(len(storage.records())):
        submission = storage.pending(commit)
        assert submission is not None
        yield from (image.tobytes() for image in submission.images)


@pytest.fixture(scope="module")
def history(tmp_path_factory: pytest.TempPathFactory) -> History:
    return History(tmp_path_factory.mktemp("history"))


def test_any_earlier_state_of_driver_and_actor_goes_on(history: History, tmp_path: Path) -> None:
    points = [None, *range(history.points)]
    last = history.points - 1
    for driver, actor in itertools.product(points, points):
        site = history.put_back(tmp_path / f"{driver}-{actor}", last, driver, actor)
        history.goes_on(site, last)
        site.close()


def test_an_earlier_memory_goes_on_and_the_learner_notices(
    history: History, tmp_path: Path
) -> None:
    last = history.points - 1
    for memory in range(last):
        for driver, actor in itertools.product((None, memory, last), repeat=2):
            site = history.put_back(tmp_path / f"{memory}-{driver}-{actor}", memory, driver, actor)
            history.goes_on(site, memory)
            assert site.turns() != history.place
            with pytest.raises(StateError, match="turn"):
                history.place.next_turns(site.storage.turns(history.place.since, 100), "file")
            site.close()
