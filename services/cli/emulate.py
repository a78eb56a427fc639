"""The commands about robots that are not there: `corridor emulate ...`."""

from __future__ import annotations

from typing import Annotated

import typer

from services.cli.options import (
    ConfigOption,
    PresetOption,
    SetOption,
    TetheredOption,
    import_installed,
    load,
)
from services.launcher.tether import tether
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
    tethered: TetheredOption = False,
) -> None:
    """A Robotino's REST interface; the first line on standard output is where it listens.

    Drive it by `corridor driver --preset robotino --set robot.robotino.address=HOST:PORT`.
    """
    if tethered:
        tether()
    emulator = import_installed("services.robot_driver.emulation.robotino", "sim")
    try:
        faults = emulator.Faults().with_texts(fault or [])
    except ValueError as error:
        raise ConfigError(f"--fault: {error}") from error
    emulator.run(world, listen, faults, typer.echo)


@emulate.command("ros2")
def emulate_ros2(
    transport: Annotated[
        str | None,
        typer.Option(metavar="bridge|rmw-zenoh", help="How it is on Zenoh (robot.ros2.transport)."),
    ] = None,
    world: World = "plus",
    listen: Annotated[
        str, typer.Option(help="Zenoh endpoint; port 0 takes a free one.")
    ] = "tcp/127.0.0.1:7448",
    fault: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="A fault from the start, such as camera=frozen or payload=truncated; repeatable. "
            "While it runs: `corridor emulate fault`.",
        ),
    ] = None,
    preset: PresetOption = None,
    config: ConfigOption = None,
    set_: SetOption = None,
    tethered: TetheredOption = False,
) -> None:
    """A ROS 2 robot's Zenoh network; the first line on standard output is where it listens.

    Topics and types are those of the configuration's robot.ros2, so that one preset serves both
    sides. Drive it by `corridor driver --preset turtlebot4 --set robot.ros2.endpoint=ENDPOINT`.
    """
    if tethered:
        tether()
    loaded = load(preset, config, set_, others={"robot.ros2.transport": transport})
    emulator = import_installed("services.robot_driver.emulation.ros2", "sim,ros2")
    try:
        faults = emulator.Ros2Faults().with_texts(fault or [])
    except ValueError as error:
        raise ConfigError(f"--fault: {error}") from error
    emulator.run(loaded.robot, world, listen, faults, typer.echo)


@emulate.command("fault")
def emulate_fault(
    changes: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME=VALUE]...",
            help="Such as camera=frozen, or camera= to end that; none: tell what is wrong now.",
        ),
    ] = None,
    endpoint: Annotated[
        str, typer.Option(help="Where the emulated robot listens.")
    ] = "tcp/127.0.0.1:7448",
) -> None:
    """Let an emulated ROS 2 robot have a fault, or tell which it has."""
    emulator = import_installed("services.robot_driver.emulation.ros2_faults", "ros2")
    typer.echo(emulator.change_faults(endpoint, changes or []))
