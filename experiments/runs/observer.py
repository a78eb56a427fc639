"""Looks at the network of a run with robots of its own, so that nothing of the run is disturbed."""

import json
import math
from pathlib import Path

from experiments.drives import routes
from experiments.drives.choosers import greedy, side_by_side
from experiments.drives.frozen_drives import DRIVERS, drive_from_first_start, evaluate, reference
from experiments.drives.predictions import prediction_figures
from experiments.drives.tour import drive_tour
from experiments.drives.traces import Figures, first_lap
from experiments.environment import CorridorEnv, with_world
from experiments.plans.plan import Plan
from experiments.records import EVALUATION_COLUMNS
from experiments.runs import probes
from services.robot_driver.robot import Pose
from shared.config import Config
from shared.rl.predictor import Predictor
from shared.run_record import Row, append_csv, read_csv
from shared.statefile import write_atomically

EVALUATIONS = "evaluations.csv"
LAP_ACTIONS = 400
"""A frozen drive that has not gone round by then does not count as one that drives laps."""


class Observer:
    """Drives with one network, frozen, in any world as its file says, and records it.

    config: Of the first stage of the run in this folder.
    """

    def __init__(self, plan: Plan, folder: Path, config: Config) -> None:
        self._plan, self._folder, self._config = plan, folder, config
        actor = config.numerics.actor
        self._network = Predictor(config.network, actor)
        self._network_of_many = Predictor(config.network, side_by_side(actor))
        """The same for robots that drive side by side."""
        self._envs: dict[str, CorridorEnv] = {}
        self._shown = b""

    def show(self, weights: bytes) -> None:
        """Look at these weights, safetensors bytes, from now on. Raises ValueError on a misfit."""
        if weights != self._shown:
            self._network.load(0, weights)
            self._network_of_many.load(0, weights)
            self._shown = weights

    def evaluate(self, world: str, now: Row, *, over: bool) -> None:
        """Drive greedily: thoroughly as a stage is `over`, briefly and in `world` on the way.

        now: Columns that say how far the run is.
        """
        settings = self._plan.evaluation
        label = f"stage {now['stage']}" if over else "every"
        starts = settings.starts if over else settings.every_starts
        actions = settings.actions if over else settings.every_length
        rows = []
        for each in (settings.worlds if over else ()) or (world,):
            done = evaluate(self._env(each), greedy(self._network_of_many), starts, actions)
            seen = self._predictions(each) if over else {}
            rows.append(_row(label, "network", each, {**done.figures, **seen}, now))
        append_csv(self._folder / EVALUATIONS, EVALUATION_COLUMNS, rows)

    def _predictions(self, world: str) -> Figures:
        """How well predictions agree with what follows; without those that cannot be told."""
        settings = self._plan.evaluation
        found = prediction_figures(
            self._env(world), self._network_of_many, settings.every_starts, settings.actions
        )
        return {name: value for name, value in found.items() if math.isfinite(value)}

    def drives_lap(self, world: str) -> bool:
        """Whether it drives round the lap centre without a bump, from the world's first start.

        Raises ValueError without a lap centre.
        """
        env = self._env(world)
        trace = drive_from_first_start(env, greedy(self._network), LAP_ACTIONS)
        return first_lap(trace, env.robot.world) is not None

    def take_pictures(self, label: str, world: str) -> None:
        """Save what the network predicts in `world` and in all worlds of the evaluation."""
        for each in sorted({world, *self._plan.evaluation.worlds}):
            path = self._folder / f"probes-{label}-{each}.npz"
            probes.take(path, self._env(each).robot, self._network)

    def drive_tours(self, world: str) -> None:
        """Carry out the test drives (A45); write their routes, and `tours.json` about all.

        Raises ValueError for a world without a route.
        """
        env, told = self._env(world), []
        for number, start in enumerate(env.robot.world.starts[: self._plan.tours]):
            pose = Pose(start.x_m, start.y_m, math.radians(start.heading_deg))
            tour = drive_tour(env, self._network, pose, number, self._plan.tour_policy)
            routes.write(self._folder / f"route-tour-{number}.npz", tour.route)
            told.append(tour.told.model_dump(mode="json"))
        write_atomically(self._folder / "tours.json", (json.dumps(told, indent=2) + "\n").encode())

    def drive_references(self, now: Row) -> None:
        """Record random actions and the planner in all worlds that were driven in."""
        settings, kept = self._plan.evaluation, self._folder.parents[1] / "references"
        path, rows = self._folder / EVALUATIONS, []
        for world in sorted({row["world"] for row in read_csv(path, EVALUATION_COLUMNS)}):
            for driver in DRIVERS:
                figures = reference(
                    self._env(world), driver, settings.starts, settings.actions, kept
                )
                rows.append(_row("reference", driver, world, figures, now))
        append_csv(path, EVALUATION_COLUMNS, rows)

    def close(self) -> None:
        """Free the simulations."""
        for env in self._envs.values():
            env.close()

    def _env(self, world: str) -> CorridorEnv:
        if world not in self._envs:
            self._envs[world] = CorridorEnv(config=with_world(self._config, world))
        return self._envs[world]


def _row(label: str, driver: str, world: str, figures: Figures, now: Row) -> Row:
    """A row of `evaluations.csv`."""
    drive = {key: round(float(value), 5) for key, value in figures.items()}
    return {"label": label, "driver": driver, "world": world, **drive, **now}
