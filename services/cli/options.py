"""Options that several commands share, each with one meaning and one help text, and their use."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from services.extras import import_installed as import_installed

if TYPE_CHECKING:
    from shared.config import Config

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
    str | None, typer.Option(help="Name of the run (run.name).", rich_help_panel=CHOOSE)
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
    int | None, typer.Option(help="Seed of all random draws (run.seed).", rich_help_panel=OURS)
]
TetheredOption = Annotated[
    bool, typer.Option("--tethered", hidden=True, help="Stop as soon as standard input closes.")
]
RobotOption = Annotated[
    str | None, typer.Option(help="Id of one robot; default: all robots of the run.")
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


Settings = Mapping[str, str | int | Path | None]
"""Values of dedicated options by key; None: not given."""


@dataclass(frozen=True)
class Sources:
    """A group of options: where the configuration comes from."""

    preset: PresetOption = None
    config: ConfigOption = None
    set_: SetOption = None

    def load(self, options: Settings | None = None) -> Config:
        """The configuration from all sources; dedicated options win over `--set`."""
        from shared import settings

        given = {k: v for k, v in (options or {}).items() if v is not None}
        plain = {k: str(v.absolute()) if isinstance(v, Path) else v for k, v in given.items()}
        chosen = [f"{k}={settings.toml_value(v)}" for k, v in plain.items()]
        return settings.load(self.preset, self.config, [*(self.set_ or []), *chosen], os.environ)


@dataclass(frozen=True)
class Which:
    """A group of options: which run is meant."""

    run: RunOption = None
    run_dir: RunDirOption = None
    endpoint: EndpointOption = None
    credentials: CredentialsOption = None

    @property
    def settings(self) -> Settings:
        """The settings that these options stand for."""
        keys = ("run.name", "bus.endpoint", "bus.credentials")
        return dict(zip(keys, (self.run, self.endpoint, self.credentials), strict=True))

    def folder(self, config: Config) -> Path:
        """The folder of the run."""
        return self.run_dir or default_folder(config)

    def reach(self, *kinds: str) -> Config:
        """How to reach a running run, with the first of these kinds of credentials there is."""
        from services.monitor import running
        from services.security.use import using

        given = str(self.credentials.absolute()) if self.credentials else None
        found = running.reach(self.run_dir, self.run, self.endpoint, os.environ, given)
        return using(found, *(kinds or ("operator", "watcher")))


def grouped(command: Callable[..., None], without: str = "") -> Callable[..., None]:
    """A command for Typer: the options of each group stand in place of the group.

    without: an option that it does not have.
    """
    groups: dict[str, Any] = {}
    options: list[inspect.Parameter] = []
    for parameter in inspect.signature(command, eval_str=True).parameters.values():
        if is_dataclass(kind := parameter.annotation):
            groups[parameter.name] = kind
            types = get_type_hints(kind, include_extras=True)
            options += [
                parameter.replace(name=f.name, default=f.default, annotation=types[f.name])
                for f in fields(kind)
            ]
        elif parameter.name != without:
            options.append(parameter)

    @wraps(command)
    def called(**values: Any) -> None:
        for name, kind in groups.items():
            values[name] = kind(**{f.name: values.pop(f.name) for f in fields(kind)})
        command(**values)

    alone = [option.replace(kind=inspect.Parameter.KEYWORD_ONLY) for option in options]
    called.__signature__ = inspect.Signature(alone)  # type: ignore[attr-defined]
    return called


def default_folder(config: Config) -> Path:
    """The folder of a run for which none was given."""
    return Path("runs") / config.run.name
