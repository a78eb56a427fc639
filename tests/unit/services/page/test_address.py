"""Where the page listens, and whose requests it takes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse
from starlette.routing import Route, WebSocketRoute
from starlette.testclient import TestClient
from starlette.websockets import WebSocket, WebSocketDisconnect

from services.page.address import Guard, listen
from shared.errors import ConfigError


def test_a_restarted_page_is_found_where_it_was(tmp_path: Path) -> None:
    kept = tmp_path / "page"
    first, address = listen(kept, "127.0.0.1", 0, insecure=False)
    assert re.fullmatch(r"http://127\.0\.0\.1:\d{5}/#[\w-]{22}", address.url)
    assert (tmp_path / "page").read_text().strip() == address.url
    assert (tmp_path / "page").stat().st_mode & 0o777 == 0o600
    other, beside = listen(kept, "127.0.0.1", 0, insecure=False)  # both at once
    assert (beside.port == address.port, beside.token) == (False, address.token)
    other.close()
    first.close()
    again, same = listen(kept, "127.0.0.1", address.port, insecure=False)
    assert same == address
    with pytest.raises(ConfigError, match="cannot listen"):
        listen(None, "127.0.0.1", address.port, insecure=False)
    again.close()


def test_beyond_loopback_only_by_name() -> None:
    with pytest.raises(ConfigError, match="--insecure"):
        listen(None, "0.0.0.0", 0, insecure=False)  # noqa: S104
    place, address = listen(None, "0.0.0.0", 0, insecure=True)  # noqa: S104
    place.close()
    assert "127.0.0.1" not in address.hosts


async def hello(_: object) -> PlainTextResponse:
    return PlainTextResponse("hello")


async def talk(socket: WebSocket) -> None:
    await socket.accept()
    await socket.close()


APP = Guard(Starlette(routes=[Route("/", hello), WebSocketRoute("/ws", talk)]), {"127.0.0.1"})
HERE = {"host": "127.0.0.1:8000"}


@pytest.mark.parametrize(
    ("headers", "ours"),
    [
        (HERE, True),
        ({**HERE, "origin": "http://127.0.0.1:8000", "sec-fetch-site": "same-origin"}, True),
        ({"host": "rebound.example:8000"}, False),
        ({"host": "127.0.0.1.example"}, False),
        ({"host": ""}, False),
        ({**HERE, "origin": "http://other.example"}, False),
        ({**HERE, "origin": "http://127.0.0.1:9999"}, False),  # another server of this machine
        ({**HERE, "origin": "null"}, False),
        ({**HERE, "sec-fetch-site": "cross-site"}, False),
        ({**HERE, "sec-fetch-site": "same-site"}, False),
    ],
)
def test_other_names_and_pages_of_others_are_refused(headers: dict[str, str], ours: bool) -> None:
    client = TestClient(APP)
    answer = client.get("/", headers=headers)
    assert answer.status_code == (200 if ours else 403)
    if ours:
        assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]
    try:
        with client.websocket_connect("/ws", headers=headers):
            taken = True
    except WebSocketDisconnect:
        taken = False
    assert taken == ours
