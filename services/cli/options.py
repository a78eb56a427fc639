"""Options that several commands share, with one meaning and one help text each, and their use."""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from shared.errors import ConfigError

if TYPE_CHECKING:
    from shared.config import Config

EXIT_CRASH, EXIT_CONFIG, EXIT_STATE = 1, 2, 3
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


def load(
    preset: str | None = None,
    file: Path | None = None,
    sets: list[str] | None = None,
    run: str | None = None,
    seed: int | None = None,
    endpoint: str | None = None,
    others: Mapping[str, str | int | None] | None = None,
) -> Config:
    """The configuration from all sources; dedicated options win over `--set`."""
    from shared import settings

    options: dict[str, str | int | None] = {
        "run.name": run,
        "run.seed": seed,
        "bus.endpoint": endpoint,
    }
    options.update(others or {})
    chosen = [f"{k}={settings.toml_value(v)}" for k, v in options.items() if v is not None]
    return settings.load(preset, file, [*(sets or []), *chosen], os.environ)


def reach(run: str | None, run_dir: Path | None, endpoint: str | None) -> Config:
    """How to reach a running run."""
    from services.monitor import running

    return running.reach(run_dir, run, endpoint, os.environ)


def import_role(module: str, role: str) -> Any:
    """A module of ours. Raises ConfigError when a library of this role is not installed."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] in {"experiments", "services", "shared"}:
            raise
        extra = "sim" if role == "driver" else role
        raise ConfigError(
            f"{role}: needs the Python package {error.name}, which is not installed: "
            f"pip install 'corridor[{extra}]'"
        ) from error
