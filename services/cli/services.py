"""The commands that run one process of a run: each service, and the router."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from services.cli.options import (
    CredentialsOption,
    InsecureOption,
    RobotsOption,
    SeedOption,
    Sources,
    TetheredOption,
    Which,
    grouped,
    import_installed,
)
from services.launcher.tether import tether
from services.processes import ACTOR, ROUTER, SERVICES, Process
from services.security.use import using

if TYPE_CHECKING:
    from shared.config import Config


def add_to(app: typer.Typer) -> None:
    """Add the commands."""
    for process in SERVICES:
        _add_service(app, process)
    app.command(ROUTER.name, help=ROUTER.purpose)(grouped(router))


def _add_service(app: typer.Typer, process: Process) -> None:
    """Add the command that runs one service in this process."""

    def command(
        sources: Sources,
        which: Which,
        seed: SeedOption = None,
        robots: RobotsOption = None,
        tethered: TetheredOption = False,
    ) -> None:
        if tethered:
            tether()
        served = [f"run.robots={robots.split(',')}"] if robots else []
        chosen = replace(sources, set_=[*(sources.set_ or []), *served])
        loaded = chosen.load({**which.settings, "run.seed": seed})
        raise typer.Exit(serve(process, loaded, which.folder(loaded)))

    without = "" if process is ACTOR else "robots"
    app.command(process.name, help=process.purpose)(grouped(command, without))


def serve(process: Process, config: Config, folder: Path) -> int:
    """Run one service until it stops; returns its exit code."""
    from shared import roles, run_record
    from shared.numerics import ROLES, settle_all
    from shared.service import guarded, new_life, setup_logging, starting
    from shared.settings import claim

    life = new_life()
    names = [".".join(config.run.robots), "", config.robot.id]
    own = using(config, *("-".join(filter(None, (process.name, name))) for name in names))

    def run() -> None:
        with starting():
            import_installed(process.module, process.extras[0]).run(own, folder, life)

    with roles.locked(
        folder, process.name, process.ident(config.robot.id, config.run.robots), life
    ):
        run_record.begin(folder, claim(folder, config))
        setup_logging(process.name, folder)
        settle_all(config, folder, [role for role in ROLES if role == process.name])
        return guarded(process.name, run)


def router(
    sources: Sources,
    listen: Annotated[
        str | None,
        typer.Option(
            help="Where to listen; default bus.endpoint, which is loopback only. Port 0 takes a "
            "free port. Example for all interfaces: tcp/0.0.0.0:7447."
        ),
    ] = None,
    credentials: CredentialsOption = None,
    insecure: InsecureOption = False,
    tethered: TetheredOption = False,
) -> None:
    """Route between the services of runs until stopped."""
    loaded = sources.load({"bus.endpoint": listen, "bus.credentials": credentials})
    bus = using(loaded, ROUTER.name).bus
    if tethered:
        tether()
    from services.router.service import run as route

    shared = bus.shared_memory
    route(bus.endpoint, typer.echo, bus.credentials, insecure=insecure, shared_memory=shared)
