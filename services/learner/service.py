"""The learner service: brings its mirror to each turn, trains, checkpoints, announces."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Literal

import numpy as np

from services.learner import checkpoint
from services.learner.mirror import Mirror
from services.processes import MAIN
from shared.config import Config
from shared.errors import StateError
from shared.inbox import Inbox
from shared.keys import LEARNER_STATE, REPLAY_STATE, TURNS, WEIGHTS
from shared.messages import LearnerState, ReplayState, Turn, Turns, TurnsRequest
from shared.metrics import MetricsLog
from shared.numerics import settle
from shared.rl.learning import Trained, Trainer
from shared.rl.network import to_bytes, weights_hash
from shared.rl.schedule import Moment
from shared.run_record import TRAINING, TRAINING_COLUMNS
from shared.service import TICK_S, Service, Stopped, service
from shared.weights import parts

Activity = Literal["waiting", "synchronising", "training", "fitting", "checkpoint"]


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
        self.episode = checkpoint.read(self._path, self._trainer, self._identity)
        self._mirror = Mirror()
        self._weights = to_bytes(self._trainer.target_network)
        self._hash = weights_hash(self._weights)
        self._metrics = MetricsLog(folder / TRAINING, TRAINING_COLUMNS)
        certain = (row for row in self._metrics.rows() if int(row["episode"]) <= self.episode)
        self._metrics.restart(list(certain))
        self._activity: Activity = "waiting"
        self._trained = Trained(0.0, 0, 0, 0)
        self._loss: float | None = None
        self._next_beat_s = 0.0
        self._known_turn = -1
        self._inbox: Inbox = me.bus.inbox()
        self._inbox.subscribe(REPLAY_STATE, "main")
        self._inbox.serve(WEIGHTS)
        me.stop.on_set(self._inbox.wake)
        me.log.info("continuing after episode %d", self.episode)

    def run(self) -> None:
        """Learn turn by turn until stopped."""
        try:
            self._check_replay()
            while not self._me.stop.is_set():
                self._inbox.wait(TICK_S if self._known_turn <= self.episode else 0.0)
                self._serve()
                if self._known_turn > self.episode:
                    turns = self._ask_turns(self.episode)
                    for turn in turns:
                        self._turn(turn)
                    if not turns:  # an announcement that was not true: wait for the next
                        self._known_turn = self.episode
        finally:
            self._metrics.close()

    def _serve(self, *, announce: bool = False) -> None:
        """Answer requests, note what replay says, publish the heartbeat when due."""
        for request in self._inbox.requests():
            with request:
                for part in parts(self._trainer.version, self._weights, self._hash):
                    request.reply(part)
        for _, state in self._inbox.take(REPLAY_STATE, ReplayState):
            self._known_turn = max(self._known_turn, state.turn)
        now_s = time.monotonic()
        if announce or now_s >= self._next_beat_s:
            busy = self._activity in ("training", "fitting")
            self._next_beat_s = now_s + (0.25 if busy else self._me.config.bus.heartbeat_s)
            self._me.bus.publish(LEARNER_STATE, self._state())

    def _check_replay(self) -> None:
        """Refuse a replay memory that never had the episodes of our checkpoint."""
        if self.episode and not self._ask_turns(self.episode - 1):
            raise StateError(
                f"replay has no turn {self.episode}, but the checkpoint {self._path} is of that "
                f"episode: they do not belong together"
            )

    def _ask_turns(self, since: int) -> tuple[Turn, ...]:
        """Turns after an episode, as replay has them. Raises Stopped."""
        request = TurnsRequest(since=since)

        def attempt() -> Turns:
            self._serve()
            return self._me.bus.request(TURNS, request, Turns)

        return self._me.insist("ask replay for turns", attempt).turns

    def _turn(self, turn: Turn) -> None:
        """Everything the learner does about one episode (E25). Raises Stopped."""
        if turn.episode != self.episode + 1:
            raise StateError(f"expected turn {self.episode + 1}, replay sent {turn.episode}")
        start_s = time.monotonic()
        self._activity = "synchronising"
        self._me.insist("pull changes from replay", lambda: self._reach(turn.change))
        steps_before = self._trainer.train_steps
        losses = self._learn(turn)
        changed = self._trainer.apply_target_rule(turn.episode, turn.bump)
        self._loss = float(np.mean(losses)) if losses else None
        self._record(turn, self._trainer.train_steps - steps_before, time.monotonic() - start_s)
        self._activity = "checkpoint"
        checkpoint.write(self._path, self._trainer, turn.episode, self._identity)
        if changed:
            self._weights = to_bytes(self._trainer.target_network)
            self._hash = weights_hash(self._weights)
        self.episode, self._activity = turn.episode, "waiting"
        self._serve(announce=True)

    def _reach(self, change: int) -> None:
        self._serve()
        self._mirror.reach(self._me.bus, change)

    def _learn(self, turn: Turn) -> list[float]:
        """All mini-batches of this turn, answering requests in between; the losses.

        Raises Stopped.
        """
        losses = []
        try:
            now = Moment(turn.episode, turn.total_actions, turn.actions)
            for trained in self._trainer.learn(self._mirror.samples, now):
                if trained.loss is not None:
                    losses.append(trained.loss)
                self._trained = trained
                self._activity = "fitting" if trained.batches else "training"
                self._serve()
                if self._me.stop.is_set():
                    raise Stopped("training")
        except FloatingPointError as error:
            raise StateError(
                f"episode {turn.episode}: {error}; the checkpoint {self._path} is of the episode "
                f"before and intact: lower learning.learning_rate in a new run"
            ) from error
        return losses

    def _record(self, turn: Turn, mini_batches: int, seconds: float) -> None:
        trainer = self._trainer
        self._metrics.write(
            {
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
        )

    def _state(self) -> LearnerState:
        trainer, trained = self._trainer, self._trained
        fitting = self._activity == "fitting"
        return LearnerState(
            id="main",
            life=self._me.life,
            episode=self.episode,
            weights_version=trainer.version,
            weights_hash=self._hash,
            activity=self._activity,
            fit_epoch=trained.epoch if fitting else 0,
            fit_batch=trained.batch if fitting else 0,
            fit_batches=trained.batches if fitting else 0,
            loss=self._loss,
            train_steps=trainer.train_steps,
            fits=trainer.fits,
            target_age=self.episode - trainer.episode_at_copy,
            resyncs=self._mirror.resyncs,
            undecodable=self._inbox.refused_total,
        )
