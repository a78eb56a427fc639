"""Commands for before the first metre: is this machine, and is this robot, ready?"""

from __future__ import annotations

import typer

from services.cli.options import (
    ConfigOption,
    EndpointOption,
    PresetOption,
    RunDirOption,
    SetOption,
    default_folder,
    load,
)


def add_to(app: typer.Typer) -> None:
    """Add the commands."""
    app.command()(doctor)


def doctor(
    preset: PresetOption = None,
    config: ConfigOption = None,
    set_: SetOption = None,
    run_dir: RunDirOption = None,
    endpoint: EndpointOption = None,
) -> None:
    """Look whether this machine can run the system; change nothing.

    The last line says that it is ready, or what to do. Exit code 1 then.
    """
    from services.monitor.doctor import run

    loaded = load(preset, config, set_, endpoint=endpoint)
    raise typer.Exit(run(loaded, run_dir or default_folder(loaded)))
