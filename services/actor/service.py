"""The actor service: answers observations of all robots of the run, hands episodes to replay."""

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from services.actor.courier import Courier
from services.actor.heard import Newest
from services.actor.session import Session
from services.actor.targets import Targets
from services.processes import ACTOR, DRIVER, LEARNER, MAIN
from shared.complaints import Complaints
from shared.config import Config, Numerics
from shared.errors import CorridorError, DiskFull
from shared.inbox import Inbox
from shared.keys import ACTOR_STATE, LEARNER_STATE, OBSERVATION, TAKEOVER
from shared.messages import LearnerState, Observation, Takeover, image_array
from shared.numerics import settle
from shared.rl.predictor import Predictor
from shared.service import TICK_S, Service, Stopped, new_life, service
from shared.weights import WeightsFetcher

MAX_ROBOTS = 32
"""Robots one actor serves; observations of more are counted as busy."""
AGAIN_S = 1.0
"""Rest of a robot after an error ended its session."""


def run(config: Config, folder: Path, life: str) -> None:
    """Serve robots until stopped; a clean stop saves the open episodes."""
    ident = ACTOR.ident("", config.run.robots)
    with service(ACTOR.name, ident, config, life=life, halts=folder) as me:
        for robot in config.run.robots[1:]:
            me.take_role(robot)
        loop = ActorLoop(me, folder / "actor", settle(config, folder, "actor"))
        with suppress(Stopped):
            loop.run()
        loop.save()  # not after a crash: what led to it must not come back


class ActorLoop:
    """One thread: observations in, actions and episodes out."""

    def __init__(self, me: Service, folder: Path, numerics: Numerics) -> None:
        self._me, self._folder = me, folder
        self._targets = Targets(me.config.network, numerics)
        self._newest = Newest()
        self._sessions: dict[str, Session] = {}
        self._known: set[str] = set()
        """Robots that had a session of this process."""
        self._failed: dict[str, float] = {}
        """When the session of a robot ended with an error."""
        self._complaints = Complaints(me.log.warning)
        self._inbox: Inbox = me.bus.inbox()
        for robot in me.config.run.robots or ("*",):
            self._inbox.subscribe(OBSERVATION, robot)
            self._inbox.subscribe(TAKEOVER, robot)
        if not me.config.run.robots:
            self._inbox.watch(ACTOR.name)
        self._inbox.subscribe(LEARNER_STATE, MAIN)
        self._inbox.watch(LEARNER.name, MAIN)
        self._inbox.watch(DRIVER.name)
        self._weights = WeightsFetcher(me, self._inbox.wake)
        self._courier = Courier(me, self._inbox.wake)
        me.stop.on_set(self._inbox.wake)
        self._next_beat_s = 0.0

    def run(self) -> None:
        """Serve until stopped."""
        while not self._me.stop.is_set():
            self._inbox.wait(min((s.tick_s for s in self._sessions.values()), default=TICK_S))
            for _, state in self._inbox.take(LEARNER_STATE, LearnerState):
                if not self._newest.note(state, self._inbox.lives(LEARNER.name, MAIN)):
                    self._inbox.refused[LEARNER_STATE.name] += 1
                    self._complaints.tell("learner", f"learner {state.life} has not the role")
            for robot, observation in self._inbox.take(OBSERVATION, Observation):
                if self._has_room(robot):
                    with self._alone(robot):
                        self._session(robot).offer(observation)
                else:
                    self._inbox.busy[OBSERVATION.name] += 1
                    self._complaints.tell(
                        "room", f"robot {robot!r} is not served: no room, or a rest"
                    )
            for robot, wish in self._inbox.take(TAKEOVER, Takeover):
                if robot in self._sessions:
                    self._note(robot, wish)
            self._answer()
            self._beat()

    def _note(self, robot: str, wish: Takeover) -> None:
        try:
            self._sessions[robot].hand.note(wish, time.monotonic())
        except OSError as error:
            self._me.log.error("%s: a restart would not know who drives: %s", robot, error)

    def _has_room(self, robot: str) -> bool:
        """Whether the robot is served, or can be now. One with an actor of its own is not."""
        if self._inbox.lives(ACTOR.name, robot) - {self._me.life}:
            self._sessions.pop(robot, None)
            return False
        failed_s = self._failed.get(robot, -AGAIN_S)
        rested = time.monotonic() - failed_s > AGAIN_S
        if robot not in self._sessions and len(self._sessions) >= MAX_ROBOTS:
            self._forget_one()
        return robot in self._sessions or (rested and len(self._sessions) < MAX_ROBOTS)

    def _forget_one(self) -> None:
        """Put away the robot that nobody has driven for the longest time; it can come back."""
        idle_s = {
            robot: session.idle_s
            for robot, session in self._sessions.items()
            if not self._inbox.lives(DRIVER.name, robot)
        }
        robot = max(idle_s, key=idle_s.__getitem__, default="")
        if robot and idle_s[robot]:
            with suppress(DiskFull):
                self._sessions[robot].save()
                del self._sessions[robot]

    @contextmanager
    def _alone(self, robot: str) -> Iterator[None]:
        """Let what goes wrong with one robot end its session alone, which begins anew later."""
        try:
            yield
        except (CorridorError, ValueError, TypeError, LookupError, ArithmeticError) as error:
            self._me.log.error("robot %r: its session ends: %s", robot, error, exc_info=True)
            self._sessions.pop(robot, None)
            self._failed[robot] = time.monotonic()

    def _answer(self) -> None:
        """Let every robot's turn go on; images seen with the same weights share a pass."""
        waiting: defaultdict[Predictor, list[tuple[Session, Observation]]] = defaultdict(list)
        for robot, session in list(self._sessions.items()):
            with self._alone(robot):
                if (observation := session.advance()) is not None:
                    waiting[session.actor.predictor].append((session, observation))
        for predictor, turns in waiting.items():
            images = np.stack([image_array(observation.image) for _, observation in turns])
            values = predictor.all_values(images)
            for (session, observation), its_own in zip(turns, values, strict=True):
                with self._alone(observation.robot):
                    session.answer(observation, its_own)

    def save(self) -> None:
        """Save all robots' open episodes."""
        for session in self._sessions.values():
            session.save()

    def _session(self, robot: str) -> Session:
        if robot not in self._sessions:
            life = new_life() if robot in self._known else self._me.life
            self._known.add(robot)
            self._sessions[robot] = Session(
                self._me,
                robot,
                life,
                self._folder / f"{robot}.msgpack",
                self._newest,
                self._weights,
                self._targets,
                self._courier,
                lambda: self._inbox.lives(DRIVER.name, robot),
            )
            if self._inbox.lives(DRIVER.name, robot):
                self._me.log.info("serving robot %r", robot)
            else:
                self._complaints.tell("stranger", f"serving robot {robot!r}, which has no token")
        return self._sessions[robot]

    def _beat(self) -> None:
        now_s = time.monotonic()
        if now_s < self._next_beat_s:
            return
        self._next_beat_s = now_s + self._me.config.bus.heartbeat_s
        for robot, session in self._sessions.items():
            state = session.heartbeat(self._inbox.refused.total(), self._inbox.busy.total())
            self._me.bus.publish(ACTOR_STATE, state, robot)
