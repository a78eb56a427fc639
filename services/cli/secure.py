"""The commands that make credentials: `corridor secure ...`. They need no router."""

import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import typer

from services.cli.options import import_installed
from services.security.kinds import KINDS, Credential
from shared.errors import ConfigError

secure = typer.Typer(
    help="Make keys, certificates and allow-lists, so that a router lets nobody else in.",
    no_args_is_help=True,
)
RoleArgument = Annotated[str, typer.Argument(metavar="ROLE", help=f"One of {', '.join(KINDS)}.")]
NamesArgument = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[NAME]...",
        help="driver: its robot. actor, pilot: robots it serves, or all. operator, watcher: whose.",
    ),
]
FolderOption = Annotated[
    Path, typer.Option("--folder", envvar="CORRIDOR_CREDENTIALS", help="What `secure init` made.")
]
HostOption = Annotated[
    list[str] | None,
    typer.Option(
        "--host",
        metavar="HOST",
        help="Name or address by which others reach the router; repeatable. Loopback always fits.",
    ),
]
DaysOption = Annotated[int, typer.Option(min=1, max=7300, help="For how long certificates hold.")]
DEFAULT, DAYS = Path("secure"), 825
RENEWED = timedelta(days=60)
"""`init` makes a certificate anew that ends within this time."""
ALWAYS = ("replay", "learner", "actor", "operator", "watcher")


@secure.command("init")
def init(
    folder: Annotated[
        Path, typer.Argument(help="Where to make it; keep it to yourself.")
    ] = DEFAULT,
    host: HostOption = None,
    robot: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="A robot that needs a driver; repeatable."),
    ] = None,
    days: DaysOption = DAYS,
    deliver: Annotated[
        Path | None,
        typer.Option(help="Copy to folders below, named like roles, where there are such, too."),
    ] = None,
) -> None:
    """Make an authority and all that a run needs; made again, only what is missing or ends soon."""
    made = _module("authority").Authority.create(folder)
    wanted = [Credential(kind) for kind in ALWAYS]
    wanted += [Credential("driver", (name,)) for name in robot or []]
    soon = datetime.now(UTC) + RENEWED
    for credential in wanted:
        if made.ends(credential.name) < soon:
            made.add(credential, _until(days))
    if not set(host or []) <= set(made.hosts) or made.ends("router") < soon:
        made.certify_router([*made.hosts, *(host or [])], _until(days))
    _tell(made)
    for folder_name in ["router", *(one.name for one in wanted)] if deliver else []:
        _copy(folder / folder_name, Path(deliver or "") / folder_name.partition("-")[0])


@secure.command("add")
def add(
    role: RoleArgument,
    name: NamesArgument = None,
    folder: FolderOption = DEFAULT,
    days: DaysOption = DAYS,
) -> None:
    """Issue a key and a certificate. One that there was under this name no longer holds."""
    made = _module("authority").Authority(folder)
    typer.echo(f"made {made.add(Credential(role, tuple(name or [])), _until(days))}")
    _tell(made)


@secure.command("revoke")
def revoke(role: RoleArgument, name: NamesArgument = None, folder: FolderOption = DEFAULT) -> None:
    """Let a certificate no longer connect, from the next start of the router on."""
    made = _module("authority").Authority(folder)
    made.revoke(Credential(role, tuple(name or [])))
    _tell(made)


@secure.command("router")
def router(
    host: HostOption = None, folder: FolderOption = DEFAULT, days: DaysOption = DAYS
) -> None:
    """Make the router's certificate anew, for these hosts, and its configuration."""
    made = _module("authority").Authority(folder)
    made.certify_router(host or [], _until(days))
    _tell(made)


@secure.command("list")
def list_(folder: FolderOption = DEFAULT) -> None:
    """List who may connect, and until when."""
    made = _module("authority").Authority(folder)
    for name in ["router", *sorted(made.credentials)]:
        typer.echo(f"{name:24} until {made.ends(name):%Y-%m-%d}")


def _module(name: str) -> Any:
    return import_installed(f"services.security.{name}", "secure")


def _until(days: int) -> datetime:
    return datetime.now(UTC) + timedelta(days=days)


def _tell(made: Any) -> None:
    """Write the router's configuration and say what is to be done with it."""
    if not made.hosts:
        raise ConfigError("router: has no certificate yet: corridor secure router")
    path = _module("router_file").write(made)
    typer.echo(f"wrote {path}: takes effect when the router starts again")


def _copy(source: Path, target: Path) -> None:
    for path in source.iterdir() if target.is_dir() else ():
        shutil.copy2(path, target / path.name)
