"""P8: steps per second while learning: ours against Stable-Baselines3's DQN in the same corridor.

Both drive the same simulated robot with a network of the same shape and train a mini-batch of 128
every four steps, in turns, each with the arithmetic it takes by itself. What differs: DQN also asks
its target network about the following images; ours also computes rewards over whole episodes.

    python -m benchmarks.peer_learning [--short | --check]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from statistics import median

import numpy as np

from benchmarks import frames, peers
from benchmarks.frame import Bar, Mode, Times, interleaved, mode_of, report, rounds_of, table
from services.actor.actor import Actor
from services.replay import numbering
from services.replay.numbering import Counters
from services.robot_driver.driver import Driver
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import load_world
from shared.config import ActorNumerics, Config, LearnerNumerics
from shared.messages import Episode
from shared.numerics import choose
from shared.rl.learning import Trainer
from shared.rl.memory import ReplayMemory
from shared.rl.network import parameter_count, to_bytes
from shared.rl.predictor import Predictor
from shared.rl.turn import sample_rows

LIFE = "0" * 12
EVERY = 4
"""Steps from one mini-batch to the next."""
NOTE = (
    "A mini-batch of DQN also asks the target network about 128 following images; ours has all "
    "rewards from when an episode ended. DQN explores without a forward pass, ours never does."
)


def configuration(mode: Mode) -> Config:
    """A full-size network that learns from the first episode; arithmetic as a run chooses it."""
    base = Config.model_validate(
        {
            "network": {"filters": frames.SIZES[mode].filters},
            "memory": {"fill": "none"},
            "learning": {"batch_size": 16 if mode == "check" else 128},
        }
    )
    if mode == "check":
        return base
    chosen = {
        "actor": choose(base, ActorNumerics(precision="auto"), "actor"),
        "learner": choose(base, LearnerNumerics(threads=0, precision="auto"), "learner"),
    }
    return base.model_copy(update={"numerics": base.numerics.model_copy(update=chosen)})


class Ours:
    """The parts of the single-process loop; a mini-batch every four steps."""

    def __init__(self, config: Config, random_steps: int) -> None:
        self.config, self._random_steps = config, random_steps
        self._robot = SimRobot(config.robot, load_world(config.robot.world), config.run.seed)
        self._driver = Driver(config, self._robot, LIFE)
        self._acting = Predictor(config.network, config.numerics.actor)
        self._actor = Actor(config, config.robot.id, LIFE, self._acting)
        self._memory, self._counters = ReplayMemory(config.memory.capacity), Counters()
        self.trainer = Trainer(
            config.network, config.learning, config.numerics.learner, config.run.seed
        )
        self._draw = np.random.default_rng(config.run.seed)
        self._steps = 0
        self._observation = self._driver.observe()
        self._publish()
        self._actor.begin(self._progress(), self._observation)

    def drive(self, steps: int) -> None:
        """Drive this many steps, with the training that falls due."""
        for _ in range(steps):
            submission = self._actor.finish(self._observation)
            if submission is not None:
                self._store(submission)
            action = self._actor.act(self._observation)
            assert action.action is not None
            self._driver.execute(action.action, action.actor_life)
            self._observation = self._driver.observe()
            self._steps += 1
            if self._steps > self._random_steps and self._steps % EVERY == 0:
                self._train()

    def close(self) -> None:
        """Free the simulation."""
        self._robot.close()

    def _store(self, episode: Episode) -> None:
        commit, self._counters = numbering.accept(self._counters, self.config.memory, episode)
        rows, images = sample_rows(episode, self._memory.worlds, commit)
        self._memory.append(rows, images)
        if self.trainer.apply_target_rule(commit.episode, episode.bump):
            self._publish()
        self._actor.committed(self._progress())

    def _train(self) -> None:
        size = self.config.learning.batch_size
        self.trainer.step(self._memory, self._draw.choice(len(self._memory), size, replace=False))

    def _publish(self) -> None:
        self._acting.load(self.trainer.version, to_bytes(self.trainer.target_network))

    def _progress(self) -> numbering.RobotProgress:
        return numbering.progress_of(self._counters, self.config.memory, self.config.robot.id)


def measure(mode: Mode) -> tuple[list[str], Bar]:
    """Seconds of equal numbers of steps in turns: the tables, and the bar P8a."""
    from benchmarks.peer_dqn import Baseline

    steps, before = {"check": (8, 60), "short": (16, 1000), "full": (40, 1000)}[mode]
    config = configuration(mode)
    theirs, ours = Baseline(config, config.learning.batch_size, EVERY, before), Ours(config, before)
    for side in (theirs, ours):
        side.drive(before)
    cases = {"Stable-Baselines3": lambda: theirs.drive(steps), "ours": lambda: ours.drive(steps)}
    trained = theirs.mini_batches, ours.trainer.train_steps
    rounds = rounds_of(mode, short=5, full=11)
    times = interleaved(cases, rounds)
    done = theirs.mini_batches - trained[0], ours.trainer.train_steps - trained[1]
    assert done == ((rounds + 1) * steps // EVERY,) * 2, f"unequal work: {done}"
    sizes = theirs.parameters, parameter_count(ours.trainer.train_network)
    theirs.close()
    ours.close()
    return tables(times, steps, sizes, config), bar(times, steps, config)


def tables(times: Times, steps: int, parameters: tuple[int, int], config: Config) -> list[str]:
    """Steps per second of both sides, and what the two do differently."""
    numerics = config.numerics
    arithmetic = [
        "float32, threads as PyTorch takes them",
        f"actor {numerics.actor.precision}, learner {numerics.learner.precision}",
    ]
    rows = [
        [name, steps / median(spent), steps * len(spent) / sum(spent), str(count), how]
        for (name, spent), count, how in zip(times.items(), parameters, arithmetic, strict=True)
    ]
    head = ["case", "steps/s, median", "steps/s, all", "parameters", "arithmetic"]
    return [table(head, rows), NOTE]


def bar(times: Times, steps: int, config: Config) -> Bar:
    """How many times as many steps a second ours takes; both medians in steps a second."""
    theirs, ours = (steps / median(times[name]) for name in ("Stable-Baselines3", "ours"))
    threads = float(config.numerics.learner.threads)
    found = Bar("P8a", ours / theirs, "x", "higher", 2.0, 2.0, theirs, ours, len(times["ours"]))
    return replace(found, checks={"learner_threads": threads})


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and report."""
    mode = mode_of(arguments, __doc__)
    peers.require(__file__, "gymnasium", "stable_baselines3")
    found, measured = measure(mode)
    report("P8 learning beside Stable-Baselines3", found, [measured])


if __name__ == "__main__":
    main()
