"""Commands that drive without learning and that record: `drive`, `teleop`, `record` ..."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from services.options import (
    ConfigFile,
    Endpoint,
    Run,
    RunDir,
    Set,
    import_role,
    load,
    reach,
)

OneRobot = Annotated[
    str | None,
    typer.Option("--robot", help="Id of the robot; default: the only one of the run."),
]


def add_to(app: typer.Typer) -> None:
    """Add the commands."""
    for command in (drive,):
        app.command()(command)


def drive(
    weights: Annotated[
        Path,
        typer.Option(help="Folder of a run, or a .safetensors file of weights."),
    ],
    robot: OneRobot = None,
    actions: Annotated[int, typer.Option(min=0, help="Stop after so many; 0: never.")] = 0,
    run: Run = None,
    run_dir: RunDir = None,
    endpoint: Endpoint = None,
    config: ConfigFile = None,
    set_: Set = None,
) -> None:
    """Let a frozen network drive a robot: nothing is learnt, nothing is stored.

    Where it predicts nothing good the robot turns on the spot. The shape of the network is that of
    the run the weights come from; --config and --set stand in for a missing config.toml. --run,
    --run-dir and --endpoint tell which run the robot belongs to.
    """
    frozen = import_role("services.actor.frozen", "actor")
    network = load(None, config or frozen.configuration_of(weights), set_).network
    command = import_role("services.actor.drive", "actor")
    there = reach(run, run_dir, endpoint)
    raise typer.Exit(command.run(there, network, weights, robot, actions, typer.echo))
