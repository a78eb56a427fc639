"""The learner service: brings its mirror to each turn, trains, checkpoints, announces."""

import math
import time
from pathlib import Path
from typing import Literal

import numpy as np

from services.learner import checkpoint
from services.learner.history import Place
from services.learner.mirror import Mirror
from services.processes import MAIN
from shared.complaints import Complaints
from shared.config import Config
from shared.errors import BusError, StateError
from shared.inbox import Inbox
from shared.keys import LEARNER_STATE, REPLAY_STATE, TURNS, WEIGHTS
from shared.messages import LearnerState, ReplayState, Turn, Turns, TurnsRequest
from shared.metrics import MetricsLog
from shared.numerics import settle
from shared.rl.learning import Trained, Trainer
from shared.rl.network import checked, to_bytes, weights_hash
from shared.rl.schedule import Moment
from shared.run_record import TRAINING, TRAINING_COLUMNS, Row
from shared.service import TICK_S, Service, Stopped, service
from shared.weights import parts

Activity = Literal["waiting", "synchronising", "training", "fitting", "checkpoint"]
TAKEOVER = 2
"""How far above the versions that replay knows a learner without its checkpoint goes on: an actor
may have one more than replay."""
SYNC_S = 60.0
"""Power cut or crash of the machine cost the turns of this time; each fit is brought to disk."""
PROBES = 16
"""Images of the memory, from all of it, that TensorBoard shows after a fit."""
LAST_TAKEOVER = 2**31
"""Above this it does not: that many versions were never made."""


class OtherTurn(Exception):
    """Replay does not have the turn any more that it told of."""


def run(config: Config, folder: Path, life: str) -> None:
    """Train until stopped; work interrupted by a stop is done again from the checkpoint."""
    with service("learner", MAIN, config, life=life, halts=folder) as me:
        LearnerLoop(me, folder).run()


class LearnerLoop:
    """One thread: the trainer, its mirror, and the answers to requests in between."""

    def __init__(self, me: Service, folder: Path) -> None:
        self._me, config = me, me.config
        self._path = folder / "learner" / "checkpoint.safetensors"
        self._identity = f"{config.run.name}/{config.run.seed}"
        numerics = settle(config, folder, "learner")
        self._trainer = Trainer(config.network, config.learning, numerics, config.run.seed)
        self._place = checkpoint.take_up(self._path, self._trainer, self._identity)
        self._mirror = Mirror()
        self._weights = self._checked_weights()
        self._hash = weights_hash(self._weights)
        self._metrics = MetricsLog(folder / TRAINING, TRAINING_COLUMNS, config)
        rows, newest = self._metrics.rows(), self._place.episode
        self._metrics.restart([row for row in rows if int(row["episode"]) <= newest])
        self._activity: Activity = "waiting"
        self._trained = Trained(0.0, 0, 0, 0)
        self._synced_s = -math.inf
        self._loss: float | None = None
        self._next_beat_s = 0.0
        self._told: Place | None = None
        """Where replay says it is, as far as nothing was done about it yet."""
        self._new = True
        """No turn was done since the start: versions may still go on above those of others."""
        self._complaints = Complaints(me.log.warning)
        self._inbox: Inbox = me.bus.inbox()
        self._inbox.subscribe(REPLAY_STATE, "main")
        self._inbox.serve(WEIGHTS)
        me.stop.on_set(self._inbox.wake)
        me.log.info("continuing after episode %d", self._place.episode)

    def run(self) -> None:
        """Learn turn by turn until stopped."""
        try:
            while not self._me.stop.is_set():
                behind = self._told is not None and self._told != self._place
                self._inbox.wait(0.0 if behind else TICK_S)
                self._serve()
                if behind:
                    self._catch_up()
        finally:
            self._metrics.close()
            checkpoint.sync(self._path)

    def _serve(self, *, announce: bool = False) -> None:
        """Answer requests, note what replay says, publish the heartbeat when due."""
        for request in self._inbox.requests():
            with request:
                for part in parts(self._trainer.version, self._weights, self._hash):
                    request.reply(part)
        for _, state in self._inbox.take(REPLAY_STATE, ReplayState):
            self._told = Place(state.turn, state.lineage)
            self._take_over(state.known_version)
        now_s = time.monotonic()
        if announce or now_s >= self._next_beat_s:
            busy = self._activity in ("training", "fitting")
            self._next_beat_s = now_s + (0.25 if busy else self._me.config.bus.heartbeat_s)
            self._me.bus.publish(LEARNER_STATE, self._state())

    def _take_over(self, known: int) -> None:
        """Go on above the versions that others have, who never take an older one."""
        own = self._trainer.version
        if self._new and own < known < LAST_TAKEOVER:
            self._trainer.version = known + TAKEOVER
            self._me.log.warning(
                "weights version %d is known to replay, this learner has come to %d only: it goes "
                "on as version %d",
                *(known, own, self._trainer.version),
            )

    def _catch_up(self) -> None:
        """Do the turns that replay has ready. Raises StateError, Stopped."""
        self._told = None
        since = self._place.since
        turns = self._me.insist("ask replay for turns", lambda: self._turns(since))
        for turn in self._place.next_turns(turns, self._path):
            try:
                self._turn(turn)
            except OtherTurn as error:
                self._activity = "waiting"
                self._complaints.tell("turn", str(error))
                return

    def _turns(self, since: int, limit: int = 100) -> tuple[Turn, ...]:
        """Turns after an episode, as replay has them. Raises BusError."""
        self._serve()
        request = TurnsRequest(since=since, limit=limit)
        return self._me.bus.request(TURNS, request, Turns).turns

    def _turn(self, turn: Turn) -> None:
        """Everything the learner does about one episode (E25). Raises Stopped, OtherTurn."""
        start_s = time.monotonic()
        self._activity = "synchronising"
        self._me.insist("pull changes from replay", lambda: self._reach(turn))
        steps_before = self._trainer.train_steps
        losses = self._learn(turn)
        self._new = False
        changed = self._trainer.apply_target_rule(turn.episode, turn.bump)
        self._loss = float(np.mean(losses)) if losses else None
        steps = self._trainer.train_steps - steps_before
        row = self._row(turn, steps, time.monotonic() - start_s)
        self._me.insist("write down a turn", lambda: self._metrics.write(row))
        if row["fitting"]:
            samples = self._mirror.samples
            ranks = np.linspace(0, len(samples) - 1, PROBES).astype(np.int64)
            network = self._trainer.train_network
            self._metrics.show_network(turn.episode, network, samples.images(ranks))
        self._activity = "checkpoint"
        try:
            weights = self._checked_weights() if changed else self._weights
            self._me.insist(
                "write a checkpoint", lambda: self._keep(turn, fitted=bool(row["fitting"]))
            )
        except FloatingPointError as error:
            raise self._diverged(turn, error) from error
        if changed:
            self._weights, self._hash = weights, weights_hash(weights)
        self._place, self._activity = Place(turn.episode, turn.lineage), "waiting"
        self._serve(announce=True)

    def _keep(self, turn: Turn, fitted: bool) -> None:
        """Write a checkpoint, and now and then bring it to disk. Raises DiskFull."""
        place = (turn.episode, self._identity, turn.lineage)
        checkpoint.keep(self._path, self._trainer, *place, self._me.config)
        if fitted or time.monotonic() - self._synced_s >= SYNC_S:
            checkpoint.sync(self._path)
            self._synced_s = time.monotonic()

    def _go_on(self) -> None:
        """Serve in between. Raises Stopped."""
        self._serve()
        if self._me.stop.is_set():
            raise Stopped("a turn")

    def _reach(self, turn: Turn) -> None:
        """Bring the mirror to a turn. Raises BusError, OtherTurn."""
        self._serve()
        followed = self._mirror.number
        try:
            self._mirror.reach(self._me.bus, turn.change, turn.lineage, self._go_on)
        except BusError:
            self._confirm(turn)
            raise
        reached = self._mirror.number
        if reached != followed and (followed is None or reached != turn.change):
            self._confirm(turn)  # a snapshot does not tell of which history it is

    def _confirm(self, turn: Turn) -> None:
        """Check that replay has a turn as it told. Raises BusError, OtherTurn."""
        if self._turns(turn.episode - 1, limit=1) != (turn,):
            raise OtherTurn(f"replay has another turn {turn.episode} than before: asking anew")

    def _checked_weights(self) -> bytes:
        """The target network as it is published. Raises FloatingPointError when it must not be."""
        data = to_bytes(self._trainer.target_network)
        try:
            checked(self._trainer.target_network, data)
        except ValueError as error:
            raise FloatingPointError(f"not published: {error}") from error
        return data

    def _diverged(self, turn: Turn, error: Exception) -> StateError:
        return StateError(
            f"episode {turn.episode}: {error}; the checkpoint {self._path} is of the episode "
            f"before and intact: lower learning.learning_rate in a new run"
        )

    def _learn(self, turn: Turn) -> list[float]:
        """All mini-batches of this turn, answering in between; the losses. Raises Stopped."""
        losses = []
        try:
            now = Moment(turn.episode, turn.total_actions, turn.actions)
            for trained in self._trainer.learn(self._mirror.samples, now):
                if trained.loss is not None:
                    losses.append(trained.loss)
                self._trained = trained
                self._activity = "fitting" if trained.batches else "training"
                self._go_on()
        except FloatingPointError as error:
            raise self._diverged(turn, error) from error
        return losses

    def _row(self, turn: Turn, mini_batches: int, seconds: float) -> Row:
        trainer = self._trainer
        return {
            "episode": turn.episode,
            "mini_batches": mini_batches,
            "loss": self._loss if self._loss is not None else "",
            "fitting": int(mini_batches > 0 and self._trained.batches > 0),
            "train_steps": trainer.train_steps,
            "fits": trainer.fits,
            "weights_version": trainer.version,
            "target_age": turn.episode - trainer.episode_at_copy,
            "turn_seconds": round(seconds, 3),
        }

    def _state(self) -> LearnerState:
        trainer, trained = self._trainer, self._trained
        fitting = self._activity == "fitting"
        return LearnerState(
            id="main",
            life=self._me.life,
            episode=self._place.episode,
            weights_version=trainer.version,
            weights_hash=self._hash,
            activity=self._activity,
            fit_epoch=trained.epoch if fitting else 0,
            fit_batch=trained.batch if fitting else 0,
            fit_batches=trained.batches if fitting else 0,
            loss=self._loss,
            train_steps=trainer.train_steps,
            fits=trainer.fits,
            target_age=self._place.episode - trainer.episode_at_copy,
            resyncs=self._mirror.resyncs,
            undecodable=self._inbox.refused.total(),
        )
