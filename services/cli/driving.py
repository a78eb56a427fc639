"""Commands that drive without learning and that record: `drive`, `teleop`, `record` ..."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from services.cli.options import (
    ConfigOption,
    CredentialsOption,
    EndpointOption,
    RunDirOption,
    RunOption,
    SetOption,
    import_installed,
    load,
    reach,
)
from services.security.use import using

DRIVING = ("pilot", "operator")
"""Credentials for driving: those of a pilot, who may send actions."""
OneRobot = Annotated[
    str | None,
    typer.Option("--robot", help="Id of the robot; default: the only one of the run."),
]


def add_to(app: typer.Typer) -> None:
    """Add the commands."""
    for command in (drive, teleop, record, playback):
        app.command()(command)


def drive(
    weights: Annotated[
        Path,
        typer.Option(help="Folder of a run, or a .safetensors file of weights."),
    ],
    robot: OneRobot = None,
    actions: Annotated[int, typer.Option(min=0, help="Stop after so many; 0: never.")] = 0,
    run: RunOption = None,
    run_dir: RunDirOption = None,
    endpoint: EndpointOption = None,
    credentials: CredentialsOption = None,
    config: ConfigOption = None,
    set_: SetOption = None,
) -> None:
    """Let a frozen network drive a robot: nothing is learnt, nothing is stored.

    Where it predicts nothing good the robot turns on the spot. The shape of the network is that of
    the run the weights come from; --config and --set stand in for a missing config.toml. --run,
    --run-dir and --endpoint tell which run the robot belongs to.
    """
    frozen = import_installed("services.commander.frozen", "actor")
    network = load(None, config or frozen.configuration_of(weights), set_).network
    command = import_installed("services.commander.drive", "actor")
    there = reach(run, run_dir, endpoint, credentials, *DRIVING)
    raise typer.Exit(command.run(there, network, weights, robot, actions, typer.echo))


def teleop(
    robot: OneRobot = None,
    run: RunOption = None,
    run_dir: RunDirOption = None,
    endpoint: EndpointOption = None,
    credentials: CredentialsOption = None,
) -> None:
    """Place a robot by keys: w a s d or arrows, space stops, e is the emergency stop, q quits.

    It moves only while keys keep coming, slowly, within all limits of its driver, and only when no
    actor commands it.
    """
    from services.commander import teleop as command

    there = reach(run, run_dir, endpoint, credentials, *DRIVING)
    raise typer.Exit(command.run(there, robot, typer.echo))


def record(
    out: Annotated[Path, typer.Option(help="File to write, such as drive.mcap.")],
    limit_mib: Annotated[
        int, typer.Option(min=1, max=1_000_000, help="End when the file is as large.")
    ] = 4096,
    run: RunOption = None,
    run_dir: RunDirOption = None,
    endpoint: EndpointOption = None,
    credentials: CredentialsOption = None,
    config: ConfigOption = None,
) -> None:
    """Record what a run publishes and its weights as MCAP, until Ctrl-C.

    The configuration is that of the run's folder; --config stands in for it on another machine.
    """
    if config:
        loaded = load(None, config, None, run, None, endpoint, credentials)
        loaded = using(loaded, "watcher", "operator")
    else:
        loaded = reach(run, run_dir, endpoint, credentials, "watcher", "operator")
    folder = run_dir or Path("runs") / loaded.run.name
    service = import_installed("services.recorder.service", "record")
    from shared.service import setup_logging

    setup_logging("recorder", None)
    raise typer.Exit(service.run(loaded, folder, out, limit_mib, typer.echo))


def playback(
    recording: Annotated[Path, typer.Argument(metavar="FILE", help="Made by corridor record.")],
) -> None:
    """Put recorded observations through preprocessing and actor; compare with recorded actions.

    Exit code 1 when an action differs, or when none could be compared.
    """
    raise typer.Exit(
        import_installed("services.recorder.playback", "record").run(recording, typer.echo)
    )
