"""One run of a plan: stages, records and snapshots round the reference loop.

Everything a run writes is listed in `experiments.records` and `shared.run_record`. A run that is
interrupted at any moment goes on from its last snapshot as if nothing had happened; what was
recorded after that snapshot is written again.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_args

import numpy as np

from experiments.drives.choosers import demonstrator
from experiments.plans.plan import Plan, stage_config
from experiments.plans.scales import divisor_of
from experiments.records import EVALUATION_COLUMNS
from experiments.runs import snapshot, stages
from experiments.runs.episode_row import episode_row, held, memory_hash
from experiments.runs.observer import EVALUATIONS, Observer
from experiments.runs.totals import Progress, Totals, Watch
from experiments.single_process import SingleProcess, TurnDone
from services.commander.frozen import packed
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import load_world
from shared.config import Config
from shared.errors import StateError
from shared.numerics import Role, settle
from shared.provenance import bundle, machine_key
from shared.rl.network import to_bytes
from shared.run_record import (
    EPISODE_COLUMNS,
    EPISODES,
    RUN,
    Row,
    RunInfo,
    StageInfo,
    append_csv,
    made_here,
    now_utc,
    read_csv,
    write_csv,
)
from shared.settings import claim
from shared.statefile import write_atomically

SNAPSHOT_EVERY_S = 60.0


class Run:
    """A plan, at the wanted scale, with a seed in a folder.

    Args:
        folder: To be made or continued.
        predecessor: Folder of the finished run this one goes on from, if the plan has one.
        command: What to run to repeat it.
        watch: Sees every turn.

    Raises:
        ConfigError: The folder belongs to another configuration.
        StateError: Snapshot or predecessor cannot be used.
    """

    def __init__(
        self,
        plan: Plan,
        scale: str,
        seed: int,
        folder: Path,
        predecessor: Path | None,
        command: str,
        watch: Watch | None = None,
    ) -> None:
        self._watch = watch or Watch()
        self.plan, self.folder, self.seed = plan, folder, seed
        self._scale = scale
        self._command, self._started = command, now_utc()
        first = claim(folder, stage_config(plan, 0, seed))
        common = folder.parents[1] / "machines" / machine_key(first)
        roles = {role: settle(first, folder, role, common) for role in get_args(Role)}
        self._numerics = first.numerics.model_copy(update=roles)
        config = self._config(0)
        world = load_world(config.robot.world)
        shows = config.memory.fill == "human"
        person = demonstrator(world, config.robot, seed) if shows else None
        self._loop = SingleProcess(config, SimRobot(config.robot, world, seed), person)
        self._totals = Totals()
        self._driving = self._best = b""
        self._observer = Observer(plan, folder, config)
        self._fitness: list[int] = []
        self._restore(predecessor)

    @property
    def _stage_name(self) -> str:
        """Name of the stage that runs, or ran last. It is empty for a plan without stages."""
        index = min(self._totals.stage, len(self.plan.stages) - 1)
        return self.plan.stages[index].name if self.plan.stages else ""

    @property
    def complete(self) -> bool:
        """Whether the last stage is over and everything written."""
        return snapshot.exists(self.folder / snapshot.END)

    def go(self, report: Callable[[Progress], None], stopped: Callable[[], bool]) -> bool:
        """Run until the plan's end or until `stopped`; returns whether it is complete."""
        if self.complete:
            return True
        if not self.plan.stages:
            self._finish()
            return True
        self._watch.begin(self._loop)
        saved_s = began_s = time.monotonic()
        for done in self._turns():
            self._totals.seconds += time.monotonic() - began_s
            self._record(done)
            self._watch.turn(self._loop, done)
            self._check_lap()
            over = self._advance(done)
            report(self._progress())
            if over:
                self._finish()
                return True
            if time.monotonic() - saved_s > SNAPSHOT_EVERY_S or stopped():
                self._save()
                saved_s = time.monotonic()
            if stopped():
                return False
            began_s = time.monotonic()
        raise AssertionError("the loop never ends by itself")

    def close(self) -> None:
        """Free the simulations."""
        self._loop.env.close()
        self._observer.close()

    # ------------------------------------------------------------ stages

    def _config(self, index: int) -> Config:
        config = stage_config(self.plan, index, self.seed)
        return config.model_copy(update={"numerics": self._numerics})

    def _turns(self) -> Iterator[TurnDone]:
        """Every turn; the memory as it is when the first episode begins is noted."""
        if not self._totals.stages:
            self._begin_stage()
        for done in self._loop.run():
            if done.commit.episode and not self._totals.prefill:
                self._totals.prefill = memory_hash(self._loop, done.commit.first_id)
            yield done

    def _begin_stage(self) -> None:
        stage, config = self.plan.stages[self._totals.stage], self._config(self._totals.stage)
        first = not self._totals.stages
        stages.enter(self._loop, self.plan, stage, config, first=first)
        self._totals.begin_stage(stage.name, config.robot.world, self._loop)
        stages.change_world(self._loop, self.plan, stage, self._totals)

    def _advance(self, done: TurnDone) -> bool:
        """Evaluate and go on to the next stage where due; whether the plan is at its end."""
        stage = self.plan.stages[self._totals.stage]
        counters = self._loop.counters
        if not done.commit.episode:
            return False
        over = self._totals.done(self._loop, self.plan.counted_in) >= stage.until
        every = self.plan.evaluation.every_actions
        due = counters.actions // every > max(self._totals.evaluated_at, 0) // every
        if self._totals.evaluated_at < 0 or due or over:
            self._totals.evaluated_at = counters.actions
            self._show()
            self._observer.evaluate(self._world, self._now(), over=over)
        if not over:
            stages.change_world(self._loop, self.plan, stage, self._totals)
            return False
        self._totals.end_stage(self._loop)
        self._show()
        self._observer.take_pictures(stage.name, self._world)
        self._totals.stage += 1
        if self._totals.stage == len(self.plan.stages):
            return True
        self._begin_stage()
        return False

    def _finish(self) -> None:
        trainer, config = self._loop.trainer, self._loop.config
        last = bundle(config, episode=self._loop.counters.episode, train_steps=trainer.train_steps)
        files = {"weights": (to_bytes(trainer.target_network), last)}
        files["best"] = self._best, bundle(config)
        for name, (data, made) in files.items():
            write_atomically(self.folder / f"{name}.safetensors", packed(data, made))
        if self.plan.tours:
            self._show()
            self._observer.drive_tours(self._world)
        self._observer.show(self._best)  # of the longest bump-free run (Fig 4.7)
        self._observer.take_pictures("best", self._world)
        self._observer.drive_references(self._now())
        self._write_run(complete=True)
        snapshot.replace(self.folder, snapshot.END, self._loop, self._extra())

    def _check_lap(self) -> None:
        """Whether the frozen policy drives a lap already. It looks only when a check is due."""
        every, actions = self.plan.evaluation.lap_every_actions, self._all_actions
        world = self._loop.env.robot.world
        if not every or self._totals.first_lap or world.lap is None:
            return
        if actions // every <= self._totals.lap_checked_at:
            return
        self._totals.lap_checked_at = actions // every
        self._show()
        if self._observer.drives_lap(world.name):
            self._totals.note_lap(self._loop)

    @property
    def _world(self) -> str:
        return self._loop.config.robot.world

    def _now(self) -> Row:
        """How far the run is, as the columns of `evaluations.csv` say it."""
        return {
            "stage": self._stage_name,
            "episode": self._loop.counters.episode,
            "total_actions": self._loop.counters.actions,
            "train_steps": self._loop.trainer.train_steps,
            "seconds": round(self._totals.seconds, 1),
        }

    @property
    def _all_actions(self) -> int:
        """Actions so far, those included that filled the memory."""
        return self._loop.actor.actions

    def _show(self) -> None:
        """Let the observer look at the target network as it is now."""
        self._observer.show(to_bytes(self._loop.trainer.target_network))

    # ------------------------------------------------------------ records

    def _record(self, done: TurnDone) -> None:
        if self._totals.count(done):
            self._best = self._driving
        if not done.commit.episode:
            return
        self._fitness = [*self._fitness[-99:], done.submitted.fitness]
        if done.target_changed:
            self._driving = to_bytes(self._loop.trainer.target_network)
        row = episode_row(self._loop, done, self._stage_name, self._totals.seconds)
        append_csv(self.folder / EPISODES, EPISODE_COLUMNS, [row])

    def _write_run(self, *, complete: bool) -> None:
        counters, plan, totals = self._loop.counters, self.plan, self._totals
        episodes = counters.episode - totals.episodes_before
        info = RunInfo(
            experiment=plan.name,
            title=plan.title,
            source=plan.source,
            scale=self._scale,
            factor=divisor_of(plan, self._scale),
            seed=self.seed,
            after=plan.after,
            command=self._command,
            **made_here(),
            numerics=self._numerics.model_dump(mode="json"),
            started=self._started,
            finished=now_utc() if complete else "",
            complete=complete,
            seconds=round(totals.seconds, 1),
            episodes=episodes,
            one_action_share=round(totals.one_action_episodes / max(episodes, 1), 5),
            actions=counters.actions,
            fill_actions=self._all_actions - counters.actions,
            train_steps=self._loop.trainer.train_steps,
            longest_run=totals.longest_run,
            prefill=totals.prefill,
            first_lap=totals.first_lap,
            memory=held(self._loop.memory),
            stages=tuple(StageInfo.model_validate(stage) for stage in totals.stages),
            thesis=plan.thesis,
        )
        write_atomically(self.folder / RUN, info.to_json())

    # ------------------------------------------------------------ snapshots

    def _extra(self) -> dict[str, Any]:
        return {
            "totals": asdict(self._totals),
            "best": self._best,
            "fitness": self._fitness,
            "started": self._started,
        }

    def _save(self) -> None:
        name = f"state-{self._loop.counters.commit}"
        snapshot.replace(self.folder, name, self._loop, self._extra())
        self._write_run(complete=False)

    def _restore(self, predecessor: Path | None) -> None:
        """Go on from the newest snapshot, from the predecessor's end, or begin."""
        own = snapshot.newest(self.folder)
        if own is not None:
            self._take_up(snapshot.restore(own, self._loop))
        elif predecessor is not None:
            end = predecessor / snapshot.END
            if not snapshot.exists(end):
                raise StateError(
                    f"{predecessor}: {self.plan.name} goes on from {self.plan.after}, which has "
                    f"not been run to its end there: run it first"
                )
            snapshot.restore(end, self._loop)
            self._totals.episodes_before = self._loop.counters.episode
            self._totals.actions_before = self._loop.counters.actions
        self._driving = to_bytes(self._loop.trainer.target_network)
        self._best = self._best or self._driving  # until an episode of this run was driven
        if not self.complete:
            self._drop_unsaved()

    def _take_up(self, extra: dict[str, Any]) -> None:
        self._totals = Totals(**extra["totals"])
        self._best = extra["best"]
        self._fitness = list(extra["fitness"])
        self._started = str(extra["started"])
        if self._totals.stage < len(self.plan.stages):
            self._loop.reconfigure(self._config(self._totals.stage))

    def _drop_unsaved(self) -> None:
        """Delete rows that were written after the snapshot: they will be written again."""
        newest = self._loop.counters.episode if self._totals.stages else 0
        for name, columns in ((EPISODES, EPISODE_COLUMNS), (EVALUATIONS, EVALUATION_COLUMNS)):
            path = self.folder / name
            rows = [r for r in read_csv(path, columns) if int(r["episode"]) <= newest]
            write_csv(path, columns, rows)

    def _progress(self) -> Progress:
        return Progress(
            run=f"{self.plan.name} {self.seed}",
            done=self._totals.done(self._loop, self.plan.counted_in),
            of=self.plan.stages[-1].until if self.plan.stages else 0,
            unit=self.plan.counted_in,
            fitness=float(np.mean(self._fitness)) if self._fitness else 0.0,
        )
