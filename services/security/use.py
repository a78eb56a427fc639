"""How processes find their credentials, and where a router may listen without any."""

from __future__ import annotations

from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING

from shared.errors import ConfigError

if TYPE_CHECKING:
    from shared.config import Config


def using(config: Config, *names: str) -> Config:
    """The configuration with the folder of one process in the place of a folder of all.

    names: folders that fit this process, the best first. Raises ConfigError when there is none.
    """
    given = config.bus.credentials
    if not given:
        return config
    for folder in (Path(given), *(Path(given) / name for name in names)):
        if (folder / "cert.pem").exists():
            bus = config.bus.model_copy(update={"credentials": str(folder.absolute())})
            return config.model_copy(update={"bus": bus})
    raise ConfigError(
        f"credentials: expected cert.pem in {given} or below in {' or '.join(names)}; "
        "`corridor secure` makes them"
    )


def refuse_open_door(listen: str, credentials: str, insecure: bool) -> None:
    """Raise ConfigError for a router that strangers could use without anybody's having said so."""
    if not credentials and not insecure and not is_local(listen):
        raise ConfigError(
            f"router: at {listen!r} whoever reaches it could drive robots: give --credentials "
            "(corridor secure init), or --insecure on a network that you trust"
        )


def is_local(endpoint: str) -> bool:
    """Whether only this machine reaches an endpoint. One without a port leads nowhere."""
    protocol, _, address = endpoint.partition("/")
    host, colon, _ = address.partition("?")[0].partition("#")[0].rpartition(":")
    if protocol.startswith("unix") or not colon or host == "localhost":
        return True
    try:
        return ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
