"""Options that several commands share, with one meaning and one help text each."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

OURS, CHOOSE = "Configuration", "Which run"
Preset = Annotated[
    str | None,
    typer.Option(
        help="Preset that comes with the package (such as demo), or a .toml file.",
        rich_help_panel=OURS,
    ),
]
ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", help="TOML file; wins over the preset.", rich_help_panel=OURS),
]
Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="SECTION.KEY=VALUE",
        help="One setting; repeatable; wins over files and environment (CORRIDOR_SECTION__KEY).",
        rich_help_panel=OURS,
    ),
]
Run = Annotated[
    str | None,
    typer.Option(help="Name of the run (run.name).", rich_help_panel=CHOOSE),
]
RunDir = Annotated[
    Path | None,
    typer.Option(help="Folder of the run; default runs/<name>.", rich_help_panel=CHOOSE),
]
Endpoint = Annotated[
    str | None,
    typer.Option(
        help="Where the router is, such as tcp/127.0.0.1:7447 (bus.endpoint).",
        rich_help_panel=CHOOSE,
    ),
]
Seed = Annotated[
    int | None,
    typer.Option(help="Seed of all random draws (run.seed).", rich_help_panel=OURS),
]
Tethered = Annotated[
    bool,
    typer.Option("--tethered", hidden=True, help="Stop as soon as standard input closes."),
]
Robot = Annotated[
    str | None,
    typer.Option(help="Id of one robot; default: all robots of the run."),
]
AtEpisode = Annotated[
    int,
    typer.Option(
        min=0, help="Wait until the robot has finished so many episodes; 0: change it now."
    ),
]
