"""Where the page is found, and whose requests it takes.

Address and token lie in the run folder, so that a page that was restarted is found where it was.
"""

import random
import re
import secrets
import socket
from collections.abc import Collection
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from shared.errors import ConfigError
from shared.statefile import write_atomically

PORTS = range(10000, 30000)
"""Kernels give none of these to outgoing connections, so a restarted page finds its port free."""
HEADERS = {
    "content-security-policy": "default-src 'self'; frame-ancestors 'none'; base-uri 'none'",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "cache-control": "no-store",
}


@dataclass(frozen=True)
class Address:
    """Host, port, and the token that commands need."""

    host: str
    port: int
    token: str

    @property
    def url(self) -> str:
        """What a person opens. Browsers send no server what stands behind the #."""
        return f"http://{self.host}:{self.port}/#{self.token}"

    @property
    def hosts(self) -> Collection[str]:
        """Names under which a browser may ask: others lead here only by rebinding of DNS."""
        return {self.host, "127.0.0.1", "localhost"} if _is_local(self.host) else {self.host}


def listen(
    file: Path | None, host: str, port: int, *, insecure: bool
) -> tuple[socket.socket, Address]:
    """Take the given port, or (0) that of before, or any other.

    file: what keeps the address. Raises ConfigError: nobody may listen there.
    """
    if not _is_local(host) and not insecure:
        raise ConfigError(
            f"--host: at {host!r} strangers see the run, and the token that commands it travels "
            "without encryption: add --insecure on a network that you trust"
        )
    before = re.match(r".*:(\d+)/#([\w-]+)", file.read_text() if file and file.exists() else "")
    token = before[2] if before else secrets.token_urlsafe(16)
    kept = [int(before[1])] if before else []
    for number in [port] if port else [*kept, *random.SystemRandom().sample(PORTS, 100)]:
        place = socket.socket()
        place.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            place.bind((host, number))
            place.listen()
        except OSError as error:
            place.close()
            problem = error
            continue
        address = Address(host, number, token)
        if file:
            write_atomically(file, f"{address.url}\n".encode())
            file.chmod(0o600)
        return place, address
    raise ConfigError(f"page: cannot listen at {host!r}, port {port}: {problem}")


def _is_local(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


class Guard:
    """Refuses requests under foreign names and from pages of others; adds headers to answers."""

    def __init__(self, app: ASGIApp, hosts: Collection[str]) -> None:
        self._app, self._hosts = app, hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it with 403."""

        async def adding(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        if self._ours(Headers(scope=scope)):
            await self._app(scope, receive, adding)
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": "refused"})
        else:
            await PlainTextResponse("refused", 403)(scope, receive, send)

    def _ours(self, headers: Headers) -> bool:
        host, origin = headers.get("host", ""), headers.get("origin")
        return (
            urlsplit(f"//{host}").hostname in self._hosts
            and (origin is None or urlsplit(origin).netloc == host)
            and headers.get("sec-fetch-site", "none") in ("none", "same-origin")
        )
