"""Options that several commands share, each with one meaning and one help text, and their use."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from shared.errors import ConfigError

if TYPE_CHECKING:
    from shared.config import Config

EXIT_CRASH, EXIT_CONFIG, EXIT_STATE, EXIT_ROLE = 1, 2, 3, 4
OURS, CHOOSE = "Configuration", "Which run"
PresetOption = Annotated[
    str | None,
    typer.Option(
        help="Preset that comes with the package (such as demo), or a .toml file.",
        rich_help_panel=OURS,
    ),
]
ConfigOption = Annotated[
    Path | None,
    typer.Option("--config", help="TOML file; wins over the preset.", rich_help_panel=OURS),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="SECTION.KEY=VALUE",
        help="One setting; repeatable; wins over files and environment (CORRIDOR_SECTION__KEY).",
        rich_help_panel=OURS,
    ),
]
RunOption = Annotated[
    str | None,
    typer.Option(help="Name of the run (run.name).", rich_help_panel=CHOOSE),
]
RunDirOption = Annotated[
    Path | None,
    typer.Option(help="Folder of the run; default runs/<name>.", rich_help_panel=CHOOSE),
]
EndpointOption = Annotated[
    str | None,
    typer.Option(
        help="Where the router is, such as tcp/127.0.0.1:7447 (bus.endpoint).",
        rich_help_panel=CHOOSE,
    ),
]
CredentialsOption = Annotated[
    Path | None,
    typer.Option(
        envvar="CORRIDOR_CREDENTIALS",
        help="Folder of keys and certificates (bus.credentials); see corridor secure.",
        rich_help_panel=CHOOSE,
    ),
]
InsecureOption = Annotated[
    bool,
    typer.Option("--insecure", help="Let the router listen beyond loopback without credentials."),
]
SeedOption = Annotated[
    int | None,
    typer.Option(help="Seed of all random draws (run.seed).", rich_help_panel=OURS),
]
TetheredOption = Annotated[
    bool,
    typer.Option("--tethered", hidden=True, help="Stop as soon as standard input closes."),
]
RobotOption = Annotated[
    str | None,
    typer.Option(help="Id of one robot; default: all robots of the run."),
]
RobotsOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME,...",
        help="Robots that it serves (run.robots); default: all that have no actor of their own.",
        rich_help_panel=CHOOSE,
    ),
]
AtEpisodeOption = Annotated[
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
    credentials: Path | None = None,
    others: Mapping[str, str | int | None] | None = None,
) -> Config:
    """The configuration from all sources; dedicated options win over `--set`."""
    from shared import settings

    options: dict[str, str | int | None] = {
        "run.name": run,
        "run.seed": seed,
        "bus.endpoint": endpoint,
        "bus.credentials": str(credentials.absolute()) if credentials else None,
    }
    options.update(others or {})
    chosen = [f"{k}={settings.toml_value(v)}" for k, v in options.items() if v is not None]
    return settings.load(preset, file, [*(sets or []), *chosen], os.environ)


def default_folder(config: Config) -> Path:
    """The folder of a run for which none was given."""
    return Path("runs") / config.run.name


def reach(
    run: str | None,
    run_dir: Path | None,
    endpoint: str | None,
    credentials: Path | None,
    *kinds: str,
) -> Config:
    """How to reach a running run, with the first of these kinds of credentials that is there."""
    from services.monitor import running
    from services.security.use import using

    given = str(credentials.absolute()) if credentials else None
    found = running.reach(run_dir, run, endpoint, os.environ, given)
    return using(found, *(kinds or ("operator", "watcher")))


def import_installed(module: str, extra: str) -> Any:
    """Import a module of ours that needs the libraries of an extra.

    Raises:
        ConfigError: one of these libraries is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] in {"experiments", "services", "shared"}:
            raise
        remedy = f"pip install 'corridor[{extra}]'"
        if error.name == "pybullet" and sys.version_info >= (3, 12):
            remedy = "it has no wheels for this Python, use Python 3.11"
        raise ConfigError(
            f"{extra}: needs the Python package {error.name}, which is not installed: {remedy}"
        ) from error
