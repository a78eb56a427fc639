"""The commands about robots that are not there: `corridor emulate ...`."""

from __future__ import annotations

from typing import Annotated

import typer

from services.monitor.tether import tether
from services.options import Tethered, import_role
from shared.errors import ConfigError

emulate = typer.Typer(
    help="Be a real robot's network interface in front of a simulated world.",
    no_args_is_help=True,
)
World = Annotated[str, typer.Option(help="World that the robot drives in, such as plus.")]


@emulate.callback()
def _emulate() -> None:
    """Be a real robot's network interface in front of a simulated world."""


@emulate.command("robotino")
def emulate_robotino(
    world: World = "plus",
    listen: Annotated[
        str, typer.Option(help="host:port; port 0 takes a free one.")
    ] = "127.0.0.1:8080",
    fault: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="A fault from the start, such as camera=frozen or network=cut; repeatable. "
            "While it runs: POST /emulator/faults.",
        ),
    ] = None,
    tethered: Tethered = False,
) -> None:
    """A Robotino's REST interface; the first line on standard output is where it listens.

    Drive it by `corridor driver --preset robotino --set robot.robotino.address=HOST:PORT`.
    """
    if tethered:
        tether()
    emulator = import_role("services.robot_driver.emulation.robotino", "driver")
    try:
        faults = emulator.Faults().with_texts(fault or [])
    except ValueError as error:
        raise ConfigError(f"--fault: {error}") from error
    emulator.run(world, listen, faults, typer.echo)
