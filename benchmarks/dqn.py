"""A baseline: DQN of Stable-Baselines3 learns in the same corridor, evaluated as ours is (E34).

docs/evaluation.md tells what is equal to a plan of ours and what is not. It needs
Stable-Baselines3, which `make bench-peers` installs into `.venv-peers`.
"""

from __future__ import annotations

import importlib.util
import time
from pathlib import Path
from typing import Annotated

import torch
import typer
from gymnasium.wrappers import TimeLimit

from experiments.drives.choosers import Chooser
from experiments.drives.frozen_drives import evaluate
from experiments.environment import REWARDS, CorridorEnv
from experiments.plans.plan import Plan, stage_config
from experiments.plans.scales import divisor_of, load_plan
from experiments.records import EVALUATION_COLUMNS
from shared.config import Config, LearnerNumerics, NumericsConfig, RunConfig
from shared.errors import ConfigError
from shared.run_record import RunInfo, StageInfo, append_csv, made_here, now_utc, write_csv
from shared.statefile import write_atomically

NAMES = {reward: f"dqn-{reward}" for reward in REWARDS}
"""Name of the experiment, by its reward."""
STAGE = "learn"
TARGET_EVERY = 1000
"""Actions between copies of the target network."""
EVALUATIONS = 10
"""In a run, at equal intervals."""
EXIT_USAGE = 2


class Dqn:
    """DQN of Stable-Baselines3 as a learner; it has driven the random actions already."""

    def __init__(self, config: Config, reward: str) -> None:
        from benchmarks import sb3

        torch.set_num_threads(config.numerics.learner.threads)
        self._random = config.memory.capacity
        env = CorridorEnv(config=config, reward=reward)
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
        return int(self._model._n_updates)


def run(config: Config, info: RunInfo, learner: Dqn, drives: tuple[int, int], out: Path) -> None:
    """Learn, evaluate at intervals; leaves `evaluations.csv` and `run.json` as our experiments do.

    Args:
        config: World and robot.
        info: What is to be run; `actions` are those after the random ones.
        learner: Who learns.
        drives: How many drives an evaluation has, and of how many actions each.
        out: Folder of the run.
    """
    out.mkdir(parents=True, exist_ok=True)
    table, seconds = out / "evaluations.csv", 0.0
    write_csv(table, EVALUATION_COLUMNS, ())
    looker = CorridorEnv(config=config)
    for number in range(1, EVALUATIONS + 1):
        begin_s = time.perf_counter()
        learner.drive(info.actions * number // EVALUATIONS - learner.actions)
        seconds += time.perf_counter() - begin_s
        found = evaluate(looker, learner.greedy, *drives).figures
        row = {
            "label": "end" if number == EVALUATIONS else "every",
            "driver": "network",
            "stage": STAGE,
            "episode": 0,
            "total_actions": learner.actions,
            "train_steps": learner.train_steps,
            "world": config.robot.world,
            **{name: round(value, 6) for name, value in found.items()},
            "seconds": round(seconds, 1),
        }
        append_csv(table, EVALUATION_COLUMNS, [row])
    looker.close()
    done = {"actions": learner.actions, "train_steps": learner.train_steps}
    stage = {"name": STAGE, "world": config.robot.world, "first_episode": 0, "last_episode": 0}
    over = {"finished": now_utc(), "complete": True, "seconds": round(seconds, 1)}
    stages = (StageInfo.model_validate({**stage, **done}),)
    told = info.model_copy(update={**over, **done, "stages": stages})
    write_atomically(out / "run.json", told.to_json())


def shared_config(like: Plan, seed: int, reward: str, threads: int) -> Config:
    """What the baseline has in common with the last stage of a plan. Raises ConfigError."""
    if reward not in NAMES:
        raise ConfigError(f"--reward: expected one of {', '.join(NAMES)}, got {reward!r}")
    run, learner = RunConfig(name=NAMES[reward], seed=seed), LearnerNumerics(threads=threads)
    numerics = NumericsConfig(learner=learner)
    ours = stage_config(like, len(like.stages) - 1, seed)
    return ours.model_copy(update={"run": run, "numerics": numerics})


app = typer.Typer(add_completion=False)


@app.command()
def main(
    out: Annotated[Path, typer.Option(help="Folder of the run.")],
    like: Annotated[str, typer.Option(help="Plan: world, network and memory.")] = "plus-rmm",
    scale: Annotated[str, typer.Option(help="Of the plan.")] = "tenth",
    actions: Annotated[int, typer.Option(min=1, help="After the random ones.")] = 50_000,
    seed: Annotated[int, typer.Option(min=0)] = 1,
    reward: Annotated[str, typer.Option(help="progress or distance.")] = "progress",
    starts: Annotated[int, typer.Option(min=1, help="Drives of an evaluation.")] = 16,
    drive_actions: Annotated[int, typer.Option(min=1, help="Of each drive.")] = 400,
    threads: Annotated[int, typer.Option(min=1)] = 1,
) -> None:
    """Let DQN of Stable-Baselines3 learn in a corridor, evaluated as our experiments are."""
    try:
        plan = load_plan(like, scale)
        config = shared_config(plan, seed, reward, threads)
        if importlib.util.find_spec("stable_baselines3") is None:
            raise ConfigError("stable_baselines3 is not installed: make bench-peers, .venv-peers")
        info = RunInfo(
            experiment=config.run.name, title=f"DQN of Stable-Baselines3, reward {reward}",
            scale=scale, factor=divisor_of(plan, scale), seed=seed, actions=actions,
            command=f"python -m benchmarks.dqn --like {like} --scale {scale} "
            f"--reward {reward} --actions {actions} --seed {seed} --starts {starts} "
            f"--drive-actions {drive_actions} --threads {threads}",
            **made_here(), started=now_utc(), stages=(),
        )  # fmt: skip
        run(config, info, Dqn(config, reward), (starts, drive_actions), out)
    except ConfigError as error:
        typer.echo(f"baseline: {error}", err=True)
        raise typer.Exit(EXIT_USAGE) from error


if __name__ == "__main__":
    app()
