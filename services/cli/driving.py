"""Commands that drive without learning and that record: `drive`, `teleop`, `takeover` ..."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from services.cli.options import (
    ConfigOption,
    Sources,
    Which,
    default_folder,
    grouped,
    import_installed,
)
from services.security.use import using

if TYPE_CHECKING:
    from shared.config import Config
    from shared.provenance import Bundle

DRIVING = ("pilot", "operator")
"""Credentials for driving: those of a pilot, who may send actions."""
OneRobot = Annotated[
    str | None, typer.Option("--robot", help="Id of the robot; default: the only one of the run.")
]


def add_to(app: typer.Typer) -> None:
    """Add the commands."""
    for command in (drive, teleop, takeover, record, playback):
        app.command()(grouped(command))
    app.command("bundle")(pack)


def drive(
    which: Which,
    sources: Sources,
    network: Annotated[
        Path,
        typer.Argument(
            metavar="NETWORK",
            help="A bundle, the folder of a run, or a .safetensors file of weights.",
        ),
    ],
    robot: OneRobot = None,
    actions: Annotated[int, typer.Option(min=0, help="Stop after so many; 0: never.")] = 0,
    video: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Film it: a new .mp4 or .gif.")
    ] = None,
) -> None:
    """Let a frozen network drive a robot: nothing is learnt, nothing is stored.

    Where it predicts nothing good the robot turns on the spot. The shape of the network is that of
    its bundle or run; --config and --set stand in for a missing one. --run, --run-dir and
    --endpoint tell which run the robot belongs to. Without a run a bundle gets a robot of its own:
    the one that it learnt on, or that of --preset and --set.
    """
    bundle = import_installed("services.commander.bundle", "actor")
    command = import_installed("services.commander.drive", "actor")
    found, made = bundle.look(network)
    with ExitStack() as stack:
        if made is None or _joins(sources.preset, which.run or which.run_dir or which.endpoint):
            there = which.reach(*DRIVING)
        else:
            there = stack.enter_context(_alone(found.path, made, sources, which.run))
        file = sources.config or bundle.frozen.configuration_of(network)
        shape = made.network if made else Sources(None, file, sources.set_).load().network
        predictor = found.predictor(shape)
        watch = None
        if video:
            film = import_installed("services.robot_driver.atlas.film", "sim")
            watch = stack.enter_context(film.filming(video, 1.0 / there.robot.period_s)).add
        code = command.run(there, predictor, found.path, robot, actions, typer.echo, watch)
    raise typer.Exit(code)


def _alone(
    file: Path, made: Bundle, sources: Sources, run: str | None
) -> AbstractContextManager[Config]:
    """A robot of its own for a bundle."""
    from services.commander import bundle
    from services.launcher.alone import alone

    base = [] if sources.preset or sources.config else bundle.overrides(made)
    settings = replace(sources, set_=[*base, *(sources.set_ or [])])
    own = settings.load({"run.name": run or "drive"})
    bundle.refuse_misfit(file, made, own.robot)
    return alone(own, default_folder(own))


def _joins(preset: str | None, chosen: object) -> bool:
    """Whether the robot is one of a run that goes on already."""
    from shared.place import those_up

    given = chosen or "CORRIDOR_BUS__ENDPOINT" in os.environ
    return preset is None and bool(given or those_up())


def pack(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")],
    out: Annotated[Path, typer.Option(help="File to write, such as robot.safetensors.")],
) -> None:
    """Write the network of a run as a bundle, which `corridor drive` takes on any machine.

    It holds the weights and what they need: shape, kind of pictures, actions, and the robot that
    they were learnt on.
    """
    made = import_installed("services.commander.bundle", "actor").make(run, out)
    origin = ", ".join(f"{name} {value}" for name, value in made.provenance.items())
    typer.echo(f"{out}: {origin}")


def teleop(which: Which, robot: OneRobot = None) -> None:
    """Place a robot by keys: w a s d or arrows, space stops, e is the emergency stop, q quits.

    It moves only while keys keep coming, slowly, within all limits of its driver, and only when no
    actor commands it.
    """
    from services.commander import teleop as command

    raise typer.Exit(command.run(which.reach(*DRIVING), robot, typer.echo))


def takeover(which: Which, robot: OneRobot = None) -> None:
    """Drive a robot that learns by keys, in place of its network: w a d or arrows, q gives it back.

    It moves only while keys keep coming and stands otherwise, until it is given back. What it sees
    meanwhile becomes samples like any others, which say that a person chose.
    """
    from services.commander import takeover as command

    raise typer.Exit(command.run(which.reach("operator"), robot, typer.echo))


def record(
    which: Which,
    out: Annotated[Path, typer.Option(help="File to write, such as drive.mcap.")],
    limit_mib: Annotated[
        int, typer.Option(min=1, max=1_000_000, help="End when the file is as large.")
    ] = 4096,
    last: Annotated[
        float,
        typer.Option(
            min=0.0, max=3600.0, help="Keep so many seconds; write them at SIGUSR1 and at the end."
        ),
    ] = 0.0,
    config: ConfigOption = None,
) -> None:
    """Record what a run publishes and its weights as MCAP, until Ctrl-C.

    The configuration is that of the run's folder; --config stands in for it on another machine.
    """
    kinds = ("watcher", "operator")
    if config:
        loaded = using(Sources(config=config).load(which.settings), *kinds)
    else:
        loaded = which.reach(*kinds)
    service = import_installed("services.recorder.service", "record")
    from services.robot_driver.simulated.world import solids
    from shared.service import setup_logging

    setup_logging("recorder", None)
    order = service.Order(out, limit_mib, last, solids)
    raise typer.Exit(service.run(loaded, which.folder(loaded), order, typer.echo))


def playback(
    recording: Annotated[Path, typer.Argument(metavar="FILE", help="Made by corridor record.")],
) -> None:
    """Put recorded observations through preprocessing and actor; compare with recorded actions.

    Exit code 1 when an action differs, or when none could be compared.
    """
    raise typer.Exit(
        import_installed("services.recorder.playback", "record").run(recording, typer.echo)
    )
