"""One run of a plan: stages, records, frozen evaluations and snapshots round the reference loop.

Everything a run writes is listed in `experiments.records` and `shared.run_record`. A run that is
interrupted at any moment goes on from its last snapshot as if nothing had happened; what was
recorded after that snapshot is written again.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, get_args

import numpy as np

from experiments.drives import routes
from experiments.drives.references import DRIVERS
from experiments.drives.traces import Figures
from experiments.plans.plan import Plan, Scale, Stage, merged, stage_config
from experiments.records import EVALUATION_COLUMNS
from experiments.runs import probes, snapshot
from experiments.runs.episode_row import episode_row, held, memory_hash
from experiments.runs.observer import Observer
from experiments.single_process import SingleProcess, TurnDone
from services.replay.numbering import bump_free
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import load_world
from shared.config import Config
from shared.errors import ConfigError, StateError
from shared.messages import WorldChange
from shared.numerics import Role, settle
from shared.provenance import machine_key
from shared.rl.network import to_bytes
from shared.rl.retention.rmm import force_candidates
from shared.rl.retention.strategy import begin
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
END = "state-end"


@dataclass(frozen=True)
class Progress:
    """How far a run is."""

    run: str
    episode: int
    episodes: int
    actions: int
    fitness: float
    """Mean of the last episodes."""


@dataclass
class Totals:
    """What the runner itself counts; saved with each snapshot."""

    seconds: float = 0.0
    """Wall time of driving and learning, evaluations not counted."""
    evaluated_at: int = -1
    """Actions at the last evaluation on the way."""
    lap_checked_at: int = -1
    first_lap: dict[str, float] = field(default_factory=dict)
    run_actions: int = 0
    """Actions since the newest bump or interruption, in this run."""
    longest_run: int = 0
    """Most actions without a bump, in this run (E10, E43)."""
    prefill: str = ""
    """Hash of the memory as the first episode began: equal for all that shared it."""
    one_action_episodes: int = 0
    """Counted episodes of this run that lasted a single action (E11)."""
    stages: list[dict[str, Any]] = field(default_factory=list)


class Run:
    """A plan with a seed in a folder.

    Args:
        plan: At the scale wanted.
        scale: Its name, for the record.
        seed: Of everything.
        folder: Of this run; made, or continued.
        predecessor: Folder of the finished run this one goes on from, if the plan has one.
        command: What to run to repeat it.

    Raises:
        ConfigError: The folder belongs to another configuration.
        StateError: Snapshot or predecessor cannot be used.
    """

    def __init__(
        self,
        plan: Plan,
        scale: Scale,
        seed: int,
        folder: Path,
        predecessor: Path | None,
        command: str,
    ) -> None:
        self.plan, self.folder, self.seed = plan, folder, seed
        self._scale: Scale = scale
        self._command, self._started = command, now_utc()
        first = claim(folder, stage_config(plan, 0, seed))
        common = folder.parents[1] / "machines" / machine_key(first)
        roles = {role: settle(first, folder, role, common) for role in get_args(Role)}
        self._numerics = first.numerics.model_copy(update=roles)
        self._loop = SingleProcess(self._config(0), self._robot(self._config(0).robot.world))
        self._totals = Totals()
        self._stage = 0
        self._offset = 0
        self._driving = self._best = b""
        self._observer = Observer(self._config(0))
        self._fitness: list[int] = []
        self._restore(predecessor)

    @property
    def _stage_name(self) -> str:
        """Of the stage that goes on, or was the last; empty of a plan without any."""
        stages = self.plan.stages
        return stages[min(self._stage, len(stages) - 1)].name if stages else ""

    @property
    def complete(self) -> bool:
        """Whether the last stage is over and everything written."""
        return snapshot.exists(self.folder / END)

    def go(self, report: Callable[[Progress], None], stopped: Callable[[], bool]) -> bool:
        """Run until the plan's end or until `stopped`; returns whether it is complete."""
        if self.complete:
            return True
        if not self.plan.stages:
            self._finish()
            return True
        saved_s = began_s = time.monotonic()
        for done in self._turns():
            self._totals.seconds += time.monotonic() - began_s
            self._record(done)
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
                before = done.commit.first_id
                self._totals.prefill = memory_hash(self._loop, before)
            yield done

    def _begin_stage(self) -> None:
        stage = self.plan.stages[self._stage]
        config = self._config(self._stage)
        loop, episode = self._loop, self._loop.counters.episode
        before = loop.config
        loop.reconfigure(config)
        if config.robot.world != loop.env.robot.world.name:
            switch = WorldChange(kind="switch", world=config.robot.world, at_episode=episode)
            self._change(switch)
        for change in stage.changes:
            at = self._offset + int(change["at_episode"])
            self._change(WorldChange.model_validate({**change, "at_episode": at}))
        if stage.force_candidates:
            force_candidates(loop.memory, loop.memory.ids)
        # Both change on the way: a stage sets them where it says something new.
        first = not self._totals.stages
        named = merged(self.plan.config, stage.config).get("memory", {})
        known, wanted = begin(before.memory), begin(config.memory)
        loop.memory.kept |= {  # a first stage that names none keeps it (E45)
            key: value
            for key, value in wanted.items()
            if (key in named if first else known[key] != value)
        }
        if first or before.memory.capacity != config.memory.capacity:
            loop.memory.set_capacity(config.memory.capacity)
        self._totals.stages.append(
            {
                "name": stage.name,
                "world": config.robot.world,
                "first_episode": episode + 1,
                "first_action": loop.counters.actions,
                "first_train_step": loop.trainer.train_steps,
                "first_second": self._totals.seconds,
            }
        )

    def _change(self, wish: WorldChange) -> None:
        """Raises ConfigError when the driver refuses."""
        answer = self._loop.env.driver.change(wish)
        if not answer.accepted:
            raise ConfigError(f"plan {self.plan.name}: {wish.kind}: {answer.reason}")

    def _advance(self, done: TurnDone) -> bool:
        """Evaluate and go on to the next stage where due; whether the plan is at its end."""
        stage = self.plan.stages[self._stage]
        counters = self._loop.counters
        if not done.commit.episode:
            return False
        over = counters.episode - self._offset >= stage.until
        every = self.plan.evaluation.every_actions
        due = counters.actions // every > max(self._totals.evaluated_at, 0) // every
        if self._totals.evaluated_at < 0 or due or over:
            self._totals.evaluated_at = counters.actions
            worlds = self.plan.evaluation.worlds if over else ()
            self._evaluate(over, worlds or (self._loop.config.robot.world,))
        if not over:
            return False
        self._end_stage(stage)
        self._stage += 1
        if self._stage == len(self.plan.stages):
            return True
        self._begin_stage()
        return False

    def _end_stage(self, stage: Stage) -> None:
        counters, entry = self._loop.counters, self._totals.stages[-1]
        entry["last_episode"] = counters.episode
        entry["actions"] = counters.actions - entry.pop("first_action")
        entry["train_steps"] = self._loop.trainer.train_steps - entry.pop("first_train_step")
        entry["seconds"] = round(self._totals.seconds - entry.pop("first_second"), 1)
        self._show()
        self._take_pictures(stage.name)

    def _take_pictures(self, label: str) -> None:
        """What the network shown to the observer predicts, in all worlds of the plan."""
        for world in sorted({self._loop.config.robot.world, *self.plan.evaluation.worlds}):
            path = self.folder / f"probes-{label}-{world}.npz"
            probes.save(path, self._observer.look(world))

    def _finish(self) -> None:
        data = to_bytes(self._loop.trainer.target_network)
        write_atomically(self.folder / "weights.safetensors", data)
        write_atomically(self.folder / "best.safetensors", self._best)
        if self.plan.tours:
            self._drive_tours()
        self._observer.show(self._best)  # of the longest bump-free run (Fig 4.7)
        self._take_pictures("best")
        self._refer()
        self._write_run(complete=True)
        snapshot.save(self.folder / END, self._loop, self._extra())
        for old in self.folder.glob("state-[0-9]*"):
            shutil.rmtree(old)

    # ------------------------------------------------------------ frozen drives

    def _evaluate(self, over: bool, worlds: tuple[str, ...]) -> None:
        """Drive frozen: thoroughly at the end of a stage, briefly on the way."""
        settings, rows = self.plan.evaluation, []
        label = f"stage {self._stage_name}" if over else "every"
        starts = settings.starts if over else settings.every_starts
        actions = settings.actions if over else settings.every_length
        self._show()
        for world in worlds:
            figures = self._observer.evaluate(world, starts, actions)
            rows.append(self._evaluation_row(label, "network", world, figures))
        append_csv(self.folder / "evaluations.csv", EVALUATION_COLUMNS, rows)

    def _drive_tours(self) -> None:
        """Test drives with turns on the spot (A45): their routes, and `tours.json` about all."""
        self._show()
        told = []
        world = self._loop.config.robot.world
        tours = self._observer.tours(world, self.plan.tours, self.plan.tour_policy)
        for number, tour in enumerate(tours):
            routes.write(self.folder / f"route-tour-{number}.npz", tour.route)
            told.append(tour.told.model_dump(mode="json"))
        write_atomically(self.folder / "tours.json", (json.dumps(told, indent=2) + "\n").encode())

    def _refer(self) -> None:
        """Record floor and ceiling of all worlds that were driven in, at the end of the record."""
        settings, kept = self.plan.evaluation, self.folder.parents[1] / "references"
        path, columns = self.folder / "evaluations.csv", EVALUATION_COLUMNS
        drives, rows = (settings.starts, settings.actions), []
        for world in sorted({row["world"] for row in read_csv(path, columns)}):
            for driver in DRIVERS:
                figures = self._observer.reference(world, driver, *drives, kept)
                rows.append(self._evaluation_row("reference", driver, world, figures))
        append_csv(path, columns, rows)

    def _evaluation_row(self, label: str, driver: str, world: str, figures: Figures) -> Row:
        counters = self._loop.counters
        return {
            "label": label,
            "driver": driver,
            "stage": self._stage_name,
            "episode": counters.episode,
            "total_actions": counters.actions,
            "train_steps": self._loop.trainer.train_steps,
            "world": world,
            **{key: _short(value) for key, value in figures.items()},
            "seconds": round(self._totals.seconds, 1),
        }

    def _check_lap(self) -> None:
        """Whether the frozen policy drives a lap already, looked at every so many actions."""
        every, actions = self.plan.evaluation.lap_every_actions, self._all_actions
        world = self._loop.env.robot.world
        if not every or self._totals.first_lap or world.lap is None:
            return
        if actions // every <= self._totals.lap_checked_at:
            return
        self._totals.lap_checked_at = actions // every
        self._show()
        if self._observer.drives_lap(world.name):
            self._totals.first_lap = {
                "seconds": round(self._totals.seconds, 1),
                "actions": actions,
                "episode": self._loop.counters.episode,
                "train_steps": self._loop.trainer.train_steps,
            }

    @property
    def _all_actions(self) -> int:
        """Those of the fill included."""
        return self._loop.actor.actions

    def _show(self) -> None:
        """Let the observer look at the target network as it is now."""
        self._observer.show(to_bytes(self._loop.trainer.target_network))

    def _robot(self, world: str) -> SimRobot:
        return SimRobot(self._config(0).robot, load_world(world), self.seed)

    # ------------------------------------------------------------ records

    def _record(self, done: TurnDone) -> None:
        episode, totals = done.submitted, self._totals
        totals.run_actions, length = bump_free(totals.run_actions, episode)
        if not done.commit.episode:
            return
        totals.one_action_episodes += episode.actions == 1
        self._fitness = [*self._fitness[-99:], episode.fitness]
        if length > totals.longest_run:
            totals.longest_run, self._best = length, self._driving
        if done.target_changed:
            self._driving = to_bytes(self._loop.trainer.target_network)
        row = episode_row(self._loop, done, self._stage_name, totals.seconds)
        append_csv(self.folder / EPISODES, EPISODE_COLUMNS, [row])

    def _write_run(self, *, complete: bool) -> None:
        counters, plan, totals = self._loop.counters, self.plan, self._totals
        mini = plan.mini if self._scale == "mini" else None
        episodes = counters.episode - self._offset
        info = RunInfo(
            experiment=plan.name,
            title=plan.title,
            source=plan.source,
            scale=self._scale,
            factor=mini.factor if mini else 1,
            memory_factor=mini.memories_by if mini else 1,
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
            one_action_share=_short(totals.one_action_episodes / max(episodes, 1)),
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
            "stage": self._stage,
            "offset": self._offset,
            "best": self._best,
            "fitness": self._fitness,
            "started": self._started,
        }

    def _save(self) -> None:
        number = self._loop.counters.commit
        snapshot.save(self.folder / f"state-{number}", self._loop, self._extra())
        for old in self.folder.glob("state-[0-9]*"):
            if old.name != f"state-{number}":
                shutil.rmtree(old)
        self._write_run(complete=False)

    def _restore(self, predecessor: Path | None) -> None:
        """Go on from the newest snapshot, from the predecessor's end, or begin."""
        own = [path for path in self.folder.glob("state-[0-9]*") if snapshot.exists(path)]
        if self.complete:
            self._take_up(snapshot.restore(self.folder / END, self._loop))
        elif own:
            newest = max(own, key=lambda path: int(path.name.removeprefix("state-")))
            self._take_up(snapshot.restore(newest, self._loop))
        elif predecessor is not None:
            if not snapshot.exists(predecessor / END):
                raise StateError(
                    f"{predecessor}: {self.plan.name} goes on from {self.plan.after}, which has "
                    f"not been run to its end there: run it first"
                )
            snapshot.restore(predecessor / END, self._loop)
            self._offset = self._loop.counters.episode
        self._driving = to_bytes(self._loop.trainer.target_network)
        self._best = self._best or self._driving  # until an episode of this run was driven
        if not self.complete:
            self._drop_unsaved()

    def _take_up(self, extra: dict[str, Any]) -> None:
        self._totals = Totals(**extra["totals"])
        self._stage, self._offset = int(extra["stage"]), int(extra["offset"])
        self._best = extra["best"]
        self._fitness = list(extra["fitness"])
        self._started = str(extra["started"])
        if self._stage < len(self.plan.stages):
            self._loop.reconfigure(self._config(self._stage))

    def _drop_unsaved(self) -> None:
        """Rows written after the snapshot come again."""
        newest = self._loop.counters.episode if self._totals.stages else 0
        for name, columns in (
            (EPISODES, EPISODE_COLUMNS),
            ("evaluations.csv", EVALUATION_COLUMNS),
        ):
            path = self.folder / name
            rows = [r for r in read_csv(path, columns) if int(r["episode"]) <= newest]
            write_csv(path, columns, rows)

    def _progress(self) -> Progress:
        episode = self._loop.counters.episode - self._offset
        return Progress(
            run=f"{self.plan.name} {self.seed}",
            episode=episode,
            episodes=self.plan.stages[-1].until if self.plan.stages else 0,
            actions=self._all_actions,
            fitness=float(np.mean(self._fitness)) if self._fitness else 0.0,
        )


def _short(value: float) -> float:
    return round(float(value), 5)
