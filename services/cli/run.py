"""The commands about a whole run: start it, look at it, stop it, halt and release its robots."""

from __future__ import annotations

import os
import select
from contextlib import suppress
from typing import TYPE_CHECKING, Annotated

import typer

from services.cli.options import (
    CHOOSE,
    CredentialsOption,
    InsecureOption,
    RobotOption,
    RunDirOption,
    RunOption,
    SeedOption,
    Sources,
    TetheredOption,
    Which,
    default_folder,
    grouped,
    import_installed,
)
from services.launcher.tether import tether

if TYPE_CHECKING:
    from shared.halts.orders import RobotOrder

GivenRouterOption = Annotated[
    str | None,
    typer.Option(
        help="Use the router at this endpoint instead of starting one.", rich_help_panel=CHOOSE
    ),
]
OwnRouterOption = Annotated[
    str | None,
    typer.Option(
        help="Where the own router listens; default: loopback, a free port.", rich_help_panel=CHOOSE
    ),
]


def add_to(app: typer.Typer) -> None:
    """Add the commands."""
    for command in (up, page, status, stop):
        app.command()(grouped(command))
    _add_order(app, "estop", "Stop robots at once; they stay stopped until `corridor clear`.")
    _add_order(app, "clear", "Release the emergency stop of robots.")
    _add_order(app, "pause", "Let robots wait after the current action, until `corridor resume`.")
    _add_order(app, "resume", "Let paused robots drive on.")
    app.command("config")(grouped(show_config))


def up(
    sources: Sources,
    run: RunOption = None,
    seed: SeedOption = None,
    run_dir: RunDirOption = None,
    endpoint: GivenRouterOption = None,
    listen: OwnRouterOption = None,
    credentials: CredentialsOption = None,
    insecure: InsecureOption = False,
    episodes: Annotated[
        int | None,
        typer.Option(help="End by itself after so many episodes (run.episodes); 0: never."),
    ] = None,
    no_page: Annotated[bool, typer.Option("--no-page", help="Do without a web page.")] = False,
) -> None:
    """Start router, replay, learner, actor and driver, and show how the robot learns.

    Ctrl-C stops everything within five seconds; the same command continues the run. The space key
    is the emergency stop of all its robots. All that a run produces lies in its folder.
    """
    with suppress(OSError):  # before much is imported, and without waiting for a reader
        if select.select([], [1], [], 0.0)[1]:
            os.write(1, b"corridor: starting\n")
    options = {"run.name": run, "run.seed": seed, "run.episodes": episodes}
    bus = {"bus.endpoint": endpoint, "bus.credentials": credentials}
    loaded = sources.load({**options, **bus})
    from services.launcher.up import run_all

    if loaded.robot.kind == "sim":  # refused before anything starts
        simulated = import_installed("services.robot_driver.simulated.world", "sim")
        simulated.load_world(loaded.robot.world)
    code = run_all(
        loaded,
        run_dir or default_folder(loaded),
        listen=listen,
        given=endpoint is not None,
        insecure=insecure,
        page=not no_page,
    )
    raise typer.Exit(code)


def page(
    which: Which,
    host: Annotated[str, typer.Option(help="Where to listen, by name.")] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="0: that of before, or any free one.")
    ] = 0,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Let the page listen beyond loopback.")
    ] = False,
    tethered: TetheredOption = False,
) -> None:
    """Show a run on a web page and let its robots be commanded there, until stopped.

    With --run-dir a run that is not up is shown as well: its curves and its memory.
    """
    if tethered:
        tether()
    service = import_installed("services.page.service", "page")
    place = (which.run_dir, which.endpoint is not None, which.reach)
    raise typer.Exit(service.run(*place, host, port, insecure))


def status(
    which: Which,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    require: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SERVICE",
            help="Exit with 1 unless this service answers; repeatable (for health checks).",
        ),
    ] = None,
) -> None:
    """List the services of a run that are alive, with versions, rates and memory."""
    from services.monitor.status import show

    raise typer.Exit(show(which.reach(), as_json=as_json, require=require or []))


def stop(
    which: Which,
    service: Annotated[
        list[str] | None,
        typer.Option(metavar="SERVICE", help="Only this service (driver, actor, ...); repeatable."),
    ] = None,
) -> None:
    """Ask the services of a run to stop cleanly; `corridor up` ends with them."""
    from services.monitor.operator import stop_services

    raise typer.Exit(stop_services(which.reach(), service or []))


def _add_order(app: typer.Typer, name: RobotOrder, text: str) -> None:
    """Add a command that robots acknowledge."""

    def command(context: typer.Context, which: Which, robot: RobotOption = None) -> None:
        from services.monitor.operator import command_robots

        raise typer.Exit(command_robots(which.reach(), name, robot, context.obj))

    app.command(name, help=text)(grouped(command))


def show_config(sources: Sources) -> None:
    """Print the resolved configuration as TOML, every key with its value."""
    from shared.settings import to_toml

    typer.echo(to_toml(sources.load()), nl=False)
