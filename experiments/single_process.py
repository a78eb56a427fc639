"""The whole system in one process: the parts wired by function calls, no bus, no disk, no threads.

Read this first: it is the algorithm of Fig 3.2 in the order of E25, made of exactly the parts the
services are made of; robot and driver together are the Gymnasium environment that everybody else
can use too. The distributed system in lockstep with synchronous learning computes the same actions,
rewards, memory, marks and weights, bit for bit; tests/system compares the two.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from experiments.environment import LIFE, CorridorEnv
from services.actor.actor import Actor
from services.replay import numbering
from services.replay.numbering import Commit, Counters
from services.robot_driver.sim import SimRobot
from shared.config import Config
from shared.messages import Episode, Observation
from shared.rl.learning import Trained, Trainer
from shared.rl.memory import ReplayMemory
from shared.rl.network import to_bytes
from shared.rl.predictor import Predictor
from shared.rl.turn import Maintenance, maintain, sample_rows


@dataclass(frozen=True)
class TurnDone:
    """One submission went all the way round."""

    commit: Commit
    submitted: Episode
    maintenance: Maintenance
    trained: tuple[Trained, ...]
    target_changed: bool


class SingleProcess:
    """Driver, actor, replay and learner of one robot as plain objects."""

    def __init__(self, config: Config, robot: SimRobot) -> None:
        self.config = config
        self.env = CorridorEnv(config=config, robot=robot)
        self.acting = Predictor(config.network, config.numerics.actor)
        self.actor = Actor(config, config.robot.id, LIFE, self.acting)
        self.memory = ReplayMemory(config.memory.capacity)
        self.counters = Counters()
        self.threshold_percent = config.memory.threshold_percent
        self.judging = Predictor(config.network, config.numerics.replay)
        self.trainer = Trainer(
            config.network, config.learning, config.numerics.learner, config.run.seed
        )
        self._publish()

    def run(self) -> Iterator[TurnDone]:
        """Drive and learn for ever; yields after every submission, fill ones included."""
        config, robot = self.config, self.config.robot.id
        observation: Observation = self.env.reset()[1]["observation"]
        self.actor.begin(numbering.progress_of(self.counters, config.memory, robot), observation)
        while True:
            submission = self.actor.finish(observation)
            if submission is not None:
                done = self._turn(submission)
                progress = numbering.progress_of(self.counters, config.memory, robot)
                self.actor.committed(progress)
                yield done
            action = self.actor.act(observation)
            assert action.action is not None
            if self.env.driver.apply_due(action.episode):
                observation = self.env.observe()
            else:
                observation = self._drive(action.action)

    def _drive(self, action: int) -> Observation:
        """Drive one action and look, after a bump from where the driver recovered to (E11)."""
        _, _, bumped, _, info = self.env.step(np.int64(action))
        if bumped:
            _, info = self.env.reset()
        observation: Observation = info["observation"]
        return observation

    def _turn(self, episode: Episode) -> TurnDone:
        """Append -> discard -> equalise -> train or fit -> target rule -> publish (E25)."""
        config = self.config
        commit, self.counters = numbering.accept(self.counters, config.memory, episode)
        rows, images = sample_rows(
            self.memory, episode, commit.first_id, commit.commit, commit.episode
        )
        self.memory.append(rows[: commit.stored], images[: commit.stored])
        maintenance = maintain(
            self.memory, commit.episode, config.memory, self.threshold_percent, self.judging
        )
        self.threshold_percent = maintenance.discarded.threshold_percent
        if not commit.episode:  # the memory is being filled: not an episode, no training (E9)
            return TurnDone(commit, episode, maintenance, (), False)
        trained = tuple(self.trainer.learn(self.memory, commit.episode))
        changed = self.trainer.apply_target_rule(commit.episode, episode.bump)
        if changed:
            self._publish()
        return TurnDone(commit, episode, maintenance, trained, changed)

    def _publish(self) -> None:
        """Acting, rewards, descriptors and equalisation all use the newest target (A26, E14)."""
        data = to_bytes(self.trainer.target_network)
        for predictor in (self.acting, self.judging):
            predictor.load(self.trainer.version, data)
