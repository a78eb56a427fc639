"""The commands about robots that are not there: `corridor emulate ...`."""

from typing import Annotated, Any

import typer

from services.cli.options import Sources, TetheredOption, grouped, import_installed
from services.launcher.tether import tether
from shared.errors import ConfigError

emulate = typer.Typer(
    help="Be a real robot's network interface in front of a simulated world.", no_args_is_help=True
)
World = Annotated[str, typer.Option(help="World that the robot drives in, such as plus.")]


def _faults_option(example: str, later: str) -> Any:
    """The option `--fault`, repeatable. later: how faults are changed while the robot runs."""
    told = f"A fault from the start, such as camera=frozen or {example}; repeatable. "
    return typer.Option(metavar="NAME=VALUE", help=f"{told}While it runs: {later}.")


def _given(sound: Any, texts: list[str] | None) -> Any:
    """These faults of a robot. Raises ConfigError."""
    try:
        return sound.with_texts(texts or [])
    except ValueError as error:
        raise ConfigError(f"--fault: {error}") from error


@emulate.command("robotino")
def emulate_robotino(
    world: World = "plus",
    listen: Annotated[
        str, typer.Option(help="host:port; port 0 takes a free one.")
    ] = "127.0.0.1:8080",
    fault: Annotated[
        list[str] | None, _faults_option("network=cut", "POST /emulator/faults")
    ] = None,
    tethered: TetheredOption = False,
) -> None:
    """A Robotino's REST interface; the first line on standard output is where it listens.

    Drive it by `corridor driver --preset robotino --set robot.robotino.address=HOST:PORT`.
    """
    if tethered:
        tether()
    emulator = import_installed("services.robot_driver.emulation.robotino", "sim")
    faults = _given(emulator.Faults(), fault)
    emulator.run(world, listen, faults, typer.echo)


@emulate.command("ros2")
@grouped
def emulate_ros2(
    sources: Sources,
    transport: Annotated[
        str | None,
        typer.Option(metavar="bridge|rmw-zenoh", help="How it is on Zenoh (robot.ros2.transport)."),
    ] = None,
    world: World = "plus",
    listen: Annotated[
        str, typer.Option(help="Zenoh endpoint; port 0 takes a free one.")
    ] = "tcp/127.0.0.1:7448",
    fault: Annotated[
        list[str] | None, _faults_option("payload=truncated", "`corridor emulate fault`")
    ] = None,
    tethered: TetheredOption = False,
) -> None:
    """A ROS 2 robot's Zenoh network; the first line on standard output is where it listens.

    Topics and types are those of the configuration's robot.ros2, so that one preset serves both
    sides. Drive it by `corridor driver --preset turtlebot4 --set robot.ros2.endpoint=ENDPOINT`.
    """
    if tethered:
        tether()
    loaded = sources.load({"robot.ros2.transport": transport})
    emulator = import_installed("services.robot_driver.emulation.ros2", "sim,ros2")
    faults = _given(emulator.Ros2Faults(), fault)
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
