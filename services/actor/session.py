"""One robot at the actor: where its turn stands, from observation to acknowledged episode."""

import time
from collections.abc import Callable, Collection
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Literal

from services.actor.actor import Actor
from services.actor.courier import Courier, Delivery
from services.actor.hand import Hand
from services.actor.heard import RIVAL_SILENT_S, Newest, ServedLife
from services.actor.targets import Targets
from shared import statefile
from shared.codec import decode, encode
from shared.complaints import Complaints
from shared.errors import BadMessage, PeerRefused, StateError
from shared.facts import ACTION_COUNT
from shared.keys import ACTION
from shared.messages import Action, ActorState, Episode, LearnerState, Observation, RobotProgress
from shared.rl.policy import Values
from shared.service import TICK_S, Service, new_life
from shared.weights import WeightsFetcher

Phase = Literal["waiting", "filling", "driving", "handing-over", "training", "person", "stopped"]
PERSON_TICK_S = 0.02
MOST_SILENT_S = 1e9


class Session:
    """One robot: its actor, and where the hand-over of its last episode stands."""

    def __init__(
        self,
        me: Service,
        robot: str,
        life: str,
        path: Path,
        newest: Newest,
        weights: WeightsFetcher,
        targets: Targets,
        courier: Courier,
        lives: Callable[[], Collection[str]],
    ) -> None:
        """Serve a robot. Each session has a life of its own. lives: who has its driver's role."""
        self._me, self._robot, self._path = me, robot, path
        self._newest, self._weights, self._targets = newest, weights, targets
        self._courier, self._served = courier, ServedLife(lives)
        self._delivery: Future[Delivery] | None = None
        self._asked: Future[RobotProgress] | None = None
        self._restored = False
        """The open episode is of an earlier process; `Actor.begin` has not judged it yet."""
        self.actor = Actor(me.config, robot, life, targets.none)
        self.hand = Hand(path.with_suffix(".taken"))
        self._pending: Episode | None = None
        """Finished, not yet acknowledged."""
        self._observation: Observation | None = None
        """Waits for its action."""
        self._finished: Observation | None = None
        """The newest observation that was asked whether it ends the open episode."""
        self._answered: tuple[tuple[str, int, int], Action] | None = None
        self._on_s = 0.0
        """When it last told of the place that was answered last, or of a later one."""
        self._complaints = Complaints(me.log.warning)
        self.stale_observations = self.rival_observations = 0
        self.resent_episodes = self.refused_episodes = 0
        self._counted = (time.monotonic(), 0)
        if (saved := statefile.take(path)) is not None:
            self._restore(saved)

    def offer(self, observation: Observation) -> None:
        """Take an observation from the inbox: new, repeated, outdated, or of a rival."""
        served = self._served
        if not served.takes(observation, time.monotonic()):
            self.rival_observations += 1
            told = f"{self._robot}: life {observation.life} is not served, {served.life} is"
            self._complaints.tell("rival", told)
            return
        place, answered = self._place(observation), self._answered
        if answered and answered[0][0] == place[0] and place < answered[0]:
            self.stale_observations += 1
            if served.heard_s - self._on_s < RIVAL_SILENT_S:
                return
            self._complaints.tell("back", f"{self._robot} is not at {answered[0]}, but at {place}")
        self._on_s = served.heard_s
        if answered and answered[0] == place:
            self._publish(answered[1])  # our answer was lost
            return
        if self._observation is None or place != self._place(self._observation):
            self._observation = observation
            self.hand.looked(served.heard_s)
            if self.actor.progress is not None:
                self._finish(observation)

    @property
    def idle_s(self) -> float:
        """How long nothing was heard of the robot; 0 while it is served, or owes an episode."""
        now_s = time.monotonic()
        gone = self._served.silent(now_s) and self._pending is None
        return now_s - self._served.heard_s if gone else 0.0

    def advance(self) -> Observation | None:
        """Do what can be done now: hand over, wait for training. Raises Stopped and StateError.

        Returns the observation that may be answered now, if there is one: see `answer`.
        """
        if self._observation is None:
            return None
        if self.actor.progress is None and not self._begun(self._observation):
            self._hold(self._observation)
            return None
        while self._pending is not None:
            if not self._handed_over(self._pending):
                self._hold(self._observation)
                return None
            if self.actor.progress is None:  # it was refused: replay says where to go on
                return None
            if self._restored:
                self.actor.begin(self.actor.progress, self._observation)
                self._restored = False
            self._finish(self._observation)  # it may have come meanwhile
        self._finish(self._observation)
        ready = self._finished is self._observation and self._pending is None and self._may_act()
        if ready and self._of_person:
            return self._as_person_wants(self._observation)
        if ready:
            self.hand.chosen = None
            return self._observation
        self._hold(self._observation)
        return None

    @property
    def tick_s(self) -> float:
        """After which time it is to go on, whatever arrives."""
        return PERSON_TICK_S if self._of_person and self._observation else TICK_S

    @property
    def _of_person(self) -> bool:
        """Whether a person drives, or is to fill the memory."""
        return self.hand.taken or (self.actor.filling and self._me.config.memory.fill == "human")

    def _as_person_wants(self, observation: Observation) -> Observation | None:
        """Let a person drive."""
        realtime = self._me.config.robot.timing == "realtime"
        do = self.hand.turn(time.monotonic(), observation.period_s, realtime=realtime)
        if do == "hold":
            self._hold(observation)
        return observation if do == "act" else None

    def answer(self, observation: Observation, values: Values) -> None:
        """Act on what `advance` returned, given what `actor.predictor` says of its image."""
        action = self.actor.act(observation, values, self.hand.chosen)
        self.hand.acted(time.monotonic())
        self._answered = (self._place(observation), action)
        self._observation = None
        self._publish(action)

    def heartbeat(self, undecodable: int, busy: int) -> ActorState:
        """What the actor tells of this robot; `undecodable` and `busy` are those of all."""
        now_s, (then_s, count) = time.monotonic(), self._counted
        rate = (self.actor.actions - count) / max(now_s - then_s, 1e-6)
        self._counted = (now_s, self.actor.actions)
        progress, action = self.actor.progress, self._answered[1] if self._answered else None
        return ActorState(
            id=self._me.ident,
            life=self.actor.life,
            robot=self._robot,
            phase=self._phase(progress),
            step=len(self.actor.open),
            robot_episode=progress.robot_episodes if progress else 0,
            weights_version=self.actor.predictor.version,
            actions=self.actor.actions,
            actions_per_s=rate,
            stale_observations=self.stale_observations,
            rival_observations=self.rival_observations,
            foreign_actions=self.actor.foreign_actions,
            refused_weights=self._weights.refused,
            refused_episodes=self.refused_episodes,
            dropped_samples=self.actor.dropped_samples,
            dropped_episodes=self.actor.dropped_episodes,
            resent_episodes=self.resent_episodes,
            undecodable=undecodable,
            busy=busy,
            taken_over=self.hand.taken,
            person=self.hand.life,
            person_silent_s=min(self.hand.silent_s(now_s), MOST_SILENT_S) * self.hand.taken,
            human_actions=self.actor.human_actions,
            refused_takeovers=self.hand.refused,
            values=action.values if action else (0.0,) * ACTION_COUNT,
        )

    def save(self) -> None:
        """Save the open episode and what is not yet acknowledged."""
        state = {"actor": self.actor.state(), "resent_episodes": self.resent_episodes}
        if self._pending is not None:
            state["pending"] = encode(self._pending)
        if self._answered is not None:
            state["answered"] = [list(self._answered[0]), encode(self._answered[1])]
        statefile.save(self._path, state)

    def _restore(self, saved: dict[str, Any]) -> None:
        try:
            self.actor.restore(saved["actor"])
            self._restored = True
            self.resent_episodes = int(saved["resent_episodes"])
            if "pending" in saved:
                self._pending = decode(saved["pending"], Episode)
            if "answered" in saved:
                (life, sequence, attempt), answer = saved["answered"]
                self._answered = ((life, sequence, attempt), decode(answer, Action))
        except (KeyError, TypeError, ValueError, BadMessage) as error:
            raise StateError(f"{self._path}: saved actor state does not fit: {error}") from error

    def _begun(self, observation: Observation) -> bool:
        """Learn from replay where this robot was; whether the answer is there. Raises Stopped."""
        if self._asked is None:
            self._asked = self._courier.ask(self._robot)
        if not self._asked.done():
            return False
        progress, self._asked = self._asked.result(), None
        if self._pending is None:
            self.actor.begin(progress, observation)
            self._restored = False
            self._finish(observation)
        else:
            self.actor.progress = progress
        return True

    def _finish(self, observation: Observation) -> None:
        """End the open episode if this observation ends it. It needs the weights of the episode.

        Once for each observation, and not before the last episode is handed over: `advance` tries
        again.
        """
        if self._pending is not None or self._finished is observation:
            return
        if len(self.actor.open) and self.actor.predictor.version == 0:
            self._load(*self._weights.newest)
            if self.actor.predictor.version == 0:
                return
        self._pending, self._finished = self.actor.finish(observation), observation

    def _handed_over(self, episode: Episode) -> bool:
        """Whether the episode is acknowledged, or refused for good and counted. Raises Stopped."""
        if self._delivery is None:
            self._delivery = self._courier.send(episode)
        if not self._delivery.done():
            return False
        delivery, self._delivery = self._delivery, None
        try:
            delivered = delivery.result()
            self.resent_episodes += delivered.attempts - 1
            progress, reason = delivered.ack.progress, delivered.ack.reason
        except PeerRefused as error:
            progress, reason = None, str(error)
        if progress is None:
            self._me.log.error("%s: episode %d lost: %s", self._robot, episode.number, reason)
            self.refused_episodes += 1
            self.actor.lose(episode, new_life())
        else:
            self.actor.committed(progress)
        self._pending = None
        return True

    def _may_act(self) -> bool:
        """Whether the next action may be chosen now; loads the weights it needs."""
        progress, learner = self.actor.progress, self._newest.state
        limit = self._me.config.run.episodes
        if progress is None or learner is None:
            return False
        if limit and progress.episode >= limit and not progress.filling:
            return False
        if self._lags(progress, learner):
            return False
        if self.actor.at_boundary or self.actor.predictor.version == 0:
            self._load(*self._weights.newest)
            synchronous = self._me.config.learning.mode == "synchronous"
            return self.actor.predictor.version >= (learner.weights_version if synchronous else 1)
        return True

    def _lags(self, progress: RobotProgress, learner: LearnerState) -> bool:
        """Whether the learner is farther behind than the robot may drive on."""
        learning = self._me.config.learning
        allowed = 0 if learning.mode == "synchronous" else learning.max_lag_episodes
        return progress.episode - learner.episode > allowed

    def _load(self, version: int, data: bytes) -> None:
        """Take up a target network, if it is newer."""
        if version > self.actor.predictor.version:
            self.actor.predictor = self._targets.of(version, data)

    def _hold(self, observation: Observation) -> None:
        """In real time, let the robot stand still for a period, which interrupts no episode."""
        if self._me.config.robot.timing != "realtime":
            return
        self._observation = None
        self.hand.held()
        self._publish(
            Action(
                robot=self._robot,
                actor_life=self.actor.life,
                robot_life=observation.life,
                sequence=observation.sequence,
                attempt=observation.attempt,
                action=None,
                by="network",
                values=(0.0,) * ACTION_COUNT,
                weights_version=self.actor.predictor.version,
                episode=self.actor.progress.robot_episodes if self.actor.progress else 0,
            )
        )

    def _publish(self, action: Action) -> None:
        self._me.bus.publish(ACTION, action, self._robot)

    def _place(self, observation: Observation) -> tuple[str, int, int]:
        return (observation.life, observation.sequence, observation.attempt)

    def _phase(self, progress: RobotProgress | None) -> Phase:
        if self._me.stop.is_set():
            return "stopped"
        if progress is None:
            return "waiting"
        if self._pending is not None:
            return "handing-over"
        learner = self._newest.state
        if self._observation is not None and learner and self._lags(progress, learner):
            return "training"
        if self._of_person:
            return "person"
        return "filling" if progress.filling else "driving"
