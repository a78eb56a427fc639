"""A baseline: DQN of Stable-Baselines3 learns in the same corridor, evaluated as ours is (E34).

Equal to a plan of ours are the environment, the convolutions with their first weights, memory,
mini-batch, constant exploration, the random actions before learning, and the number of actions.
Different are what makes it DQN: one output per action instead of actions as an input, a discount
factor and bootstrapped values, and its optimiser and update frequencies, which are
Stable-Baselines3's defaults except for the target network, copied every 1,000 actions because runs
are short.

Reward `progress` is the environment's own: how far the action led, -1 at a bump. It does not tell
driving from circling. Reward `distance` comes nearer to ours: how far the robot is from where it
was 50 actions ago, of the farthest possible.

    python -m experiments.baseline.dqn --like plus-rmm --actions 50000 --seed 1 --out DIR

needs Stable-Baselines3 (`make bench-peers` installs it into `.venv-peers`).
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import shlex
import sys
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import TimeLimit

from experiments.drives.choosers import Chooser
from experiments.drives.frozen_drives import evaluate
from experiments.environment import CorridorEnv, Image
from experiments.plans.plan import stage_config
from experiments.plans.scales import SCALES, divisor_of, load_plan
from experiments.records import EVALUATION_COLUMNS
from services.robot_driver.simulated.world import WorldError
from shared.config import Config
from shared.errors import ConfigError
from shared.run_record import RunInfo, StageInfo, append_csv, made_here, now_utc, write_csv
from shared.statefile import write_atomically

NAMES = {"progress": "dqn-progress", "distance": "dqn-distance"}
"""Name of the experiment, by its reward."""
STAGE = "learn"
TARGET_EVERY = 1000
"""Actions between copies of the target network."""
EVALUATIONS = 10
"""In a run, at equal intervals."""
EXIT_USAGE = 2


@dataclass(frozen=True)
class BaselinePlan:
    """A run of the baseline, as the command line asks for it."""

    config: Config
    scale: str
    factor: int
    actions: int
    reward: str
    starts: int
    drive_actions: int
    out: Path
    command: str


class DistanceReward(gymnasium.Wrapper[Image, np.int64, Image, np.int64]):
    """Rewards distance from where the robot was some actions ago; -1 at a bump stays.

    Until there are so many actions in an episode its first place counts.
    """

    def __init__(self, env: gymnasium.Env[Image, np.int64], config: Config) -> None:
        super().__init__(env)
        self._max_distance_m = config.max_distance_m
        self._places: deque[tuple[float, float]] = deque(maxlen=config.episode.horizon + 1)

    def reset(self, **given: Any) -> tuple[Image, dict[str, Any]]:
        """Begin an episode."""
        image, info = self.env.reset(**given)
        self._places.clear()
        self._remember(info)
        return image, info

    def step(self, action: np.int64) -> tuple[Image, float, bool, bool, dict[str, Any]]:
        """Drive one action."""
        image, reward, terminated, truncated, info = self.env.step(action)
        if not terminated:
            self._remember(info)
            reward = math.dist(self._places[0], self._places[-1]) / self._max_distance_m
        return image, float(reward), terminated, truncated, info

    def _remember(self, info: dict[str, Any]) -> None:
        seen = info["observation"]
        self._places.append((seen.x_m, seen.y_m))


class Dqn:
    """DQN of Stable-Baselines3 as a learner; it has driven the random actions already."""

    def __init__(self, plan: BaselinePlan) -> None:
        from experiments.baseline import sb3

        self._sb3, config = sb3, plan.config
        sb3.use_threads(config.numerics.learner.threads)
        env: gymnasium.Env[Image, np.int64] = CorridorEnv(config=config)
        if plan.reward == "distance":
            env = DistanceReward(env, config)
        self._random = config.memory.capacity
        self._model = sb3.dqn(
            TimeLimit(env, config.episode.max_samples), config,
            random_steps=self._random, target_update_interval=TARGET_EVERY,
        )  # fmt: skip
        self.greedy: Chooser = sb3.greedy(self._model)
        """The frozen policy."""
        self.drive(self._random)

    def drive(self, actions: int) -> None:
        """Drive this many more actions, with the training that falls due."""
        self._model.learn(actions, reset_num_timesteps=False)

    @property
    def actions(self) -> int:
        """Driven so far, the random ones before learning not included."""
        return int(self._model.num_timesteps) - self._random

    @property
    def train_steps(self) -> int:
        """Mini-batches trained so far."""
        return self._sb3.mini_batches(self._model)


def run(plan: BaselinePlan, learner: Dqn) -> None:
    """Learn, evaluate at intervals; leaves `evaluations.csv` and `run.json` as our experiments do.

    `seconds` is the wall time of learning alone.
    """
    plan.out.mkdir(parents=True, exist_ok=True)
    table, seconds, began = plan.out / "evaluations.csv", 0.0, now_utc()
    write_csv(table, EVALUATION_COLUMNS, ())
    looker = CorridorEnv(config=plan.config)
    for number in range(1, EVALUATIONS + 1):
        begin_s = time.perf_counter()
        learner.drive(plan.actions * number // EVALUATIONS - learner.actions)
        seconds += time.perf_counter() - begin_s
        found = evaluate(looker, learner.greedy, plan.starts, plan.drive_actions).figures
        row = {
            "label": "end" if number == EVALUATIONS else "every",
            "driver": "network",
            "stage": STAGE,
            "episode": 0,
            "total_actions": learner.actions,
            "train_steps": learner.train_steps,
            "world": plan.config.robot.world,
            **{name: round(value, 6) for name, value in found.items()},
            "seconds": round(seconds, 1),
        }
        append_csv(table, EVALUATION_COLUMNS, [row])
    looker.close()
    write_atomically(plan.out / "run.json", _told(plan, learner, round(seconds, 1), began))


def _told(plan: BaselinePlan, learner: Dqn, seconds: float, began: str) -> bytes:
    """What was run, with the names that reports of experiments read."""
    done = {"actions": learner.actions, "train_steps": learner.train_steps}
    stage = {"name": STAGE, "world": plan.config.robot.world, "first_episode": 0, "last_episode": 0}
    return RunInfo(
        experiment=NAMES[plan.reward],
        title=f"DQN of Stable-Baselines3, reward {plan.reward}",
        scale=plan.scale,
        factor=plan.factor,
        seed=plan.config.run.seed,
        command=plan.command,
        **made_here(),
        started=began,
        finished=now_utc(),
        complete=True,
        seconds=seconds,
        stages=(StageInfo.model_validate({**stage, **done}),),
        **done,
    ).to_json()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the baseline; returns the exit code."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    try:
        plan = planned(words)
    except ConfigError as error:
        return _refused(str(error))
    if importlib.util.find_spec("stable_baselines3") is None:
        return _refused("stable_baselines3 is not installed: make bench-peers, then .venv-peers")
    try:
        learner = Dqn(plan)
    except WorldError as error:
        return _refused(str(error))
    run(plan, learner)
    return 0


def planned(words: Sequence[str]) -> BaselinePlan:
    """The plan that the command line asks for. Raises ConfigError."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.baseline.dqn", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--like", default="plus-rmm", help="plan: world, network and memory")
    parser.add_argument("--scale", choices=SCALES, default="tenth", help="of the plan")
    parser.add_argument("--actions", type=_positive, default=50_000, help="after the random ones")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--reward", choices=NAMES, default="progress")
    parser.add_argument("--starts", type=_positive, default=16, help="drives of an evaluation")
    parser.add_argument("--drive-actions", type=_positive, default=400, help="of each drive")
    parser.add_argument("--threads", type=_positive, default=1)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args(words)
    like = load_plan(given.like, given.scale)
    ours = stage_config(like, len(like.stages) - 1, given.seed)
    config = Config.model_validate(
        {
            "run": {"name": NAMES[given.reward], "seed": given.seed},
            "robot": ours.robot.model_dump(),
            "episode": ours.episode.model_dump(),
            "policy": {"kind": "eps-greedy", "epsilon": ours.policy.epsilon},
            "network": ours.network.model_dump(),
            "memory": {"capacity": ours.memory.capacity, "strategy": "normm"},
            "numerics": {"learner": {"threads": given.threads}},
        }
    )
    told = list(words)  # without where to: a place on this machine, and no part of what was run
    if "--out" in told:
        del told[told.index("--out") : told.index("--out") + 2]
    command = shlex.join(["python", "-m", "experiments.baseline.dqn", *told])
    return BaselinePlan(
        config, given.scale, divisor_of(like, given.scale), given.actions,
        given.reward, given.starts, given.drive_actions, given.out, command,
    )  # fmt: skip


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"expected at least 1, got {number}")
    return number


def _refused(message: str) -> int:
    sys.stderr.write(f"baseline_dqn: {message}\n")
    return EXIT_USAGE


if __name__ == "__main__":
    sys.exit(main())
