"""Frozen drives and pictures that a run has taken of its network, and the files about them."""

from __future__ import annotations

import json
from pathlib import Path

from experiments.drives import routes
from experiments.drives.references import DRIVERS
from experiments.drives.traces import Figures
from experiments.plans.plan import Plan
from experiments.records import EVALUATION_COLUMNS
from experiments.runs import probes
from experiments.runs.observer import Observer
from shared.config import Config
from shared.run_record import Row, append_csv, read_csv
from shared.statefile import write_atomically

EVALUATIONS = "evaluations.csv"


class Evaluations:
    """Drives with the network as thoroughly as a plan says, and records it.

    Args:
        plan: Plan of the run.
        folder: Folder of the run.
        config: Configuration of its first stage.
    """

    def __init__(self, plan: Plan, folder: Path, config: Config) -> None:
        self._plan, self._folder = plan, folder
        self._observer = Observer(config)

    def show(self, weights: bytes) -> None:
        """Look at these weights, safetensors bytes, from now on."""
        self._observer.show(weights)

    def drive(self, world: str, now: Row, *, over: bool) -> None:
        """Drive frozen: thoroughly at the end of a stage, in `world` alone on the way.

        Args:
            world: Where the run drives.
            now: Columns that say how far the run is.
            over: Whether the stage is over.
        """
        settings = self._plan.evaluation
        label = f"stage {now['stage']}" if over else "every"
        starts = settings.starts if over else settings.every_starts
        actions = settings.actions if over else settings.every_length
        rows = [
            _row(label, "network", each, self._observer.evaluate(each, starts, actions), now)
            for each in (settings.worlds if over else ()) or (world,)
        ]
        append_csv(self._folder / EVALUATIONS, EVALUATION_COLUMNS, rows)

    def drive_tours(self, world: str) -> None:
        """Carry out the test drives (A45); write their routes, and `tours.json` about all."""
        told = []
        tours = self._observer.tours(world, self._plan.tours, self._plan.tour_policy)
        for number, tour in enumerate(tours):
            routes.write(self._folder / f"route-tour-{number}.npz", tour.route)
            told.append(tour.told.model_dump(mode="json"))
        write_atomically(self._folder / "tours.json", (json.dumps(told, indent=2) + "\n").encode())

    def drive_references(self, now: Row) -> None:
        """Record random actions and the planner in all worlds that were driven in."""
        settings, kept = self._plan.evaluation, self._folder.parents[1] / "references"
        path, rows = self._folder / EVALUATIONS, []
        for world in sorted({row["world"] for row in read_csv(path, EVALUATION_COLUMNS)}):
            for driver in DRIVERS:
                figures = self._observer.reference(
                    world, driver, settings.starts, settings.actions, kept
                )
                rows.append(_row("reference", driver, world, figures, now))
        append_csv(path, EVALUATION_COLUMNS, rows)

    def drives_lap(self, world: str) -> bool:
        """Whether the network drives a lap without a bump."""
        return self._observer.drives_lap(world)

    def take_pictures(self, label: str, world: str) -> None:
        """Save what the network predicts in `world` and in all worlds of the evaluation."""
        for each in sorted({world, *self._plan.evaluation.worlds}):
            probes.save(self._folder / f"probes-{label}-{each}.npz", self._observer.look(each))

    def close(self) -> None:
        """Free the simulations."""
        self._observer.close()


def _row(label: str, driver: str, world: str, figures: Figures, now: Row) -> Row:
    """A row of `evaluations.csv`."""
    drive = {key: round(float(value), 5) for key, value in figures.items()}
    return {"label": label, "driver": driver, "world": world, **drive, **now}
