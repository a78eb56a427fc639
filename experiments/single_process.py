"""The whole system in one process: the parts wired by function calls, without bus or disk.

One thread runs it all; only gradients are computed by as many threads as `numerics.learner` says.

Read this first: it is the algorithm of Fig 3.2 in the order of E25, made of exactly the parts the
services are made of; robot and driver together are the Gymnasium environment that everybody else
can use too. The distributed system in lockstep with synchronous learning computes the same actions,
rewards, memory, marks and weights, bit for bit; tests/system compares the two.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from experiments.environment import LIFE, CorridorEnv
from services.actor.actor import Actor
from services.replay import numbering
from services.replay.numbering import Counters
from services.robot_driver.simulated.sim import SimRobot
from shared.config import Config
from shared.errors import ConfigError
from shared.messages import Episode, Observation, RobotProgress
from shared.rl.learning import Trained, Trainer
from shared.rl.memory import ReplayMemory
from shared.rl.network import to_bytes
from shared.rl.predictor import Predictor
from shared.rl.schedule import Moment
from shared.rl.turn import Commit, Maintenance, maintain, sample_rows

Person = Callable[[Observation], int | None]
"""The action that a person wants; None: they leave it to the network."""


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

    def __init__(self, config: Config, robot: SimRobot, person: Person | None = None) -> None:
        """person: drives while the memory is filled. Raises ConfigError where one is missing."""
        if config.memory.fill == "human" and person is None:
            raise ConfigError("memory.fill 'human': expected a person who drives, got none")
        self.config, self._person = config, person
        self.env = CorridorEnv(config=config, robot=robot)
        self.acting = Predictor(config.network, config.numerics.actor)
        self.actor = Actor(config, config.robot.id, LIFE, self.acting)
        self.memory = ReplayMemory(config.memory.capacity)
        self.counters = Counters()
        self.judging = Predictor(config.network, config.numerics.replay)
        self.trainer = Trainer(
            config.network, config.learning, config.numerics.learner, config.run.seed
        )
        self.publish()

    def reconfigure(self, config: Config) -> None:
        """Go on with other settings of policy, memory and learning, as a new stage begins.

        Call between turns. The world changes by way of the driver; capacity and threshold in force,
        which change on the way, stay as they are.
        """
        self.config = config
        self.counters = numbering.refill(self.counters, config.memory, len(self.memory))
        self.trainer.configure(config.learning)
        self.actor.configure(config)
        if self.actor.progress is not None:
            self.actor.progress = self._progress()

    def run(self) -> Iterator[TurnDone]:
        """Drive and learn for ever; yields after every submission, fill ones included."""
        self.env.reset()
        observation = self.env.seen
        self.actor.begin(self._progress(), observation)
        while True:
            submission = self.actor.finish(observation)
            if submission is not None:
                done = self._turn(submission)
                self.actor.committed(self._progress())
                yield done
            wish = self._person(observation) if self._person and self.actor.filling else None
            action = self.actor.act(observation, wish=wish)
            assert action.action is not None
            if self.env.driver.apply_due(action.episode):
                observation = self.env.observe()
            else:
                observation = self._drive(action.action)

    def _drive(self, action: int) -> Observation:
        """Drive one action and look, after a bump from where the driver recovered to (E11)."""
        if self.env.step(np.int64(action))[2]:
            self.env.reset()
        return self.env.seen

    def _progress(self) -> RobotProgress:
        return numbering.progress_of(self.counters, self.config.memory, self.config.robot.id)

    def _turn(self, episode: Episode) -> TurnDone:
        """Append -> discard -> equalise -> train or fit -> target rule -> publish (E25)."""
        config = self.config
        commit, self.counters = numbering.accept(self.counters, config.memory, episode)
        rows, images = sample_rows(episode, self.memory.worlds, commit)
        self.memory.append(rows, images)
        now = Moment(commit.episode, self.counters.actions, episode.actions)
        maintenance = maintain(self.memory, now, config.memory, self.judging, config.run.seed)
        if not commit.episode:  # the memory is being filled: not an episode, no training (E9)
            return TurnDone(commit, episode, maintenance, (), False)
        trained = tuple(self.trainer.learn(self.memory, now))
        changed = self.trainer.apply_target_rule(commit.episode, episode.bump)
        if changed:
            self.publish()
        return TurnDone(commit, episode, maintenance, trained, changed)

    def publish(self) -> None:
        """Acting, rewards, descriptors and equalisation all use the newest target (A26, E14)."""
        data = to_bytes(self.trainer.target_network)
        for predictor in (self.acting, self.judging):
            predictor.load(self.trainer.version, data)
