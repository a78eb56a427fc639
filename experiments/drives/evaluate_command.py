"""`corridor evaluate`: what the network of a run can do, beside planner and random actions."""

from collections.abc import Callable, Mapping
from math import isfinite
from pathlib import Path

from rich.console import Console
from rich.table import Table

from experiments.drives import routes
from experiments.drives.choosers import Chooser, Planned, greedy, side_by_side, uniform
from experiments.drives.frozen_drives import evaluate
from experiments.drives.predictions import prediction_figures
from experiments.drives.traces import Figures
from experiments.environment import CorridorEnv
from experiments.records import EVALUATION_COLUMNS
from services.commander import frozen
from services.robot_driver.simulated.world import WorldError
from shared.config import ActorNumerics, Config
from shared.errors import ConfigError
from shared.run_record import Row, write_csv

LABEL = "evaluate"
SHOWN = {
    "bumps_per_1000": "bumps per 1,000 actions",
    "bumps_per_100m": "bumps per 100 m",
    "mean_run": "mean bump-free run, actions",
    "longest_run": "longest bump-free run, actions",
    "fitness": "fitness (runs capped at 500)",
    "laps_left_per_1000": "laps left per 1,000 actions",
    "laps_right_per_1000": "laps right per 1,000 actions",
    "distance": "distance from 50 actions ago, of the farthest possible",
    "coverage": "free cells visited",
    "circling": "actions spent circling",
}
PREDICTED = {
    "wall_value": "prediction of actions that hit a wall within 6 actions",
    "value_rank": "rank correlation of predictions with observed rewards",
    "value_slope": "slope of observed rewards over predictions",
}
"""Figures of the network alone, on drives that explore."""
SHARES = ("distance", "coverage", "circling")


def run(path: Path, config: Config, starts: int, actions: int, out: Path) -> None:
    """Evaluate in the configured world; print a table, write `evaluation.csv`, routes and pictures.

    path: The folder of a run, or a file of weights.

    Raises:
        ConfigError: No such run, no such world, another shape of network, or an unwritable folder.
        StateError: The network's file is damaged.
    """
    weights = frozen.read(frozen.find(path))
    predictor = weights.predictor(config.network, side_by_side(ActorNumerics()))
    network = greedy(predictor)
    try:
        env = CorridorEnv(config=config)
    except WorldError as error:
        raise ConfigError(f"robot.world: {error}") from error
    try:
        drivers = (
            ("network", lambda: network), ("random", lambda: uniform),
            ("planner", lambda: Planned(env.world, config.robot)),
        )  # fmt: skip
        found = {name: _drive(env, make, starts, actions, name, out) for name, make in drivers}
        judged = prediction_figures(env, predictor, starts, actions)
        found["network"] |= {name: value for name, value in judged.items() if isfinite(value)}
    finally:
        env.close()
    rows = [_row(name, config, weights, figures) for name, figures in found.items()]
    write_csv(out / "evaluation.csv", EVALUATION_COLUMNS, rows)
    Console().print(table(config.robot.world, found))


def table(world: str, found: Mapping[str, Figures]) -> Table:
    """Figures by driver, one row each."""
    actions = round(next(iter(found.values()))["actions"])
    shown = Table(title=f"{world}: {actions} actions without learning", title_justify="left")
    shown.add_column("figure")
    for driver in found:
        shown.add_column(driver, justify="right")
    for name, text in (SHOWN | PREDICTED).items():
        told = (_text(name, each[name]) if name in each else "-" for each in found.values())
        shown.add_row(text, *told)
    return shown


def _drive(
    env: CorridorEnv, make: Callable[[], Chooser], starts: int, actions: int, name: str, out: Path
) -> Figures:
    """Drive from all starts; write the ways."""
    done = evaluate(env, make(), starts, actions)
    title = (
        f"{env.world.name}: {name}, {done.figures['bumps_per_1000']:.1f} bumps per 1,000 actions"
    )
    try:
        out.mkdir(parents=True, exist_ok=True)
        routes.write(out / f"route-{name}.npz", routes.Route(done.traces[0]))
        picture = routes.figure(env.world, done.traces, title)
        picture.savefig(out / f"routes-{name}.png", format="png")
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written: {error.strerror}") from error
    return done.figures


def _row(name: str, config: Config, weights: frozen.Frozen, figures: Figures) -> Row:
    """The random driver and the planner have learnt nothing."""
    learnt = name == "network"
    known = {"episode": weights.episode, "train_steps": weights.train_steps} if learnt else {}
    return {
        "label": LABEL if learnt else "reference",
        "driver": name,
        "world": config.robot.world,
        **{key: value for key, value in known.items() if value is not None},
        **{key: round(value, 6) for key, value in figures.items()},
        "seconds": 0.0,
    }


def _text(name: str, value: float) -> str:
    if name in SHARES:
        return f"{value:.1%}"
    return f"{value:.0f}" if name == "longest_run" else f"{value:.2f}"
