"""The web server of the page: its files, one WebSocket for each browser, figures, the memory.

A browser gets the next update when it has painted the last one, at most five a second: what it is
too slow for is never sent.
"""

import asyncio
import logging
import secrets
import socket
from collections.abc import Awaitable, Callable
from pathlib import Path

import anyio
import uvicorn
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, generate_latest
from pydantic import ValidationError
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from services.commander.takeover import Person
from services.page.address import Address, Guard
from services.page.browse import Answer, Browser
from services.page.commands import MOST_BYTES, Command, Desk
from services.page.metrics import Figures
from services.page.watch import PERIOD_S, Watch
from shared.errors import CorridorError, first_problem

log = logging.getLogger(__name__)
MOST_BROWSERS = 16
PAINTED_S = 30.0
"""A browser that has not painted an update within this time is let go; it comes again."""
ALIVE_S = 1.0
"""Without news an update is sent after this time all the same, so that silence means something."""
STATIC = Path(__file__).parent / "static"


class Link:
    """One browser: what it knows, and what it has painted."""

    def __init__(self, watch: Watch, desk: Desk, token: str, socket_: WebSocket) -> None:
        self._watch, self._desk, self._token, self._socket = watch, desk, token, socket_
        self._known: dict[str, str] = {}
        self._number, self._painted = 0, asyncio.Event()
        self._people: dict[str, Person] = {}

    def update(self) -> str:
        """The sections that the browser does not know as they are; it knows them then."""
        fresh = {k: v for k, v in self._watch.sections.items() if self._known.get(k) is not v}
        self._known |= fresh
        self._number += 1
        parts = ",".join(f'"{name}":{text}' for name, text in fresh.items())
        return f'{{"number":{self._number},"sections":{{{parts}}}}}'

    async def send(self) -> None:
        """Send updates for ever, each after the last one was painted."""
        while True:
            self._painted.clear()
            await self._socket.send_text(self.update())
            with anyio.fail_after(PAINTED_S):
                await self._painted.wait()
            for _ in range(round(ALIVE_S / PERIOD_S)):
                await asyncio.sleep(PERIOD_S)
                if any(self._known.get(k) is not v for k, v in self._watch.sections.items()):
                    break

    async def receive(self) -> None:
        """Take messages for ever; what is wrong with one goes back to its sender alone."""
        while True:
            text = await self._socket.receive_text()
            if complaint := self.take(text):
                await self._socket.send_json({"refused": complaint})

    def take(self, text: str) -> str:
        """Do what a message says; why not, if so."""
        if len(text) > MOST_BYTES:
            return f"expected at most {MOST_BYTES} bytes"
        try:
            command = Command.model_validate_json(text)
        except ValidationError as error:
            return first_problem(error)
        if command.seen is not None:
            if command.seen == self._number:
                self._painted.set()
            return ""
        if not secrets.compare_digest(command.token.encode(), self._token.encode()):
            return "this address has no valid token: it shows the run, but commands nothing"
        try:
            if command.wish and command.robot:
                self._desk.drive(command.robot, command.wish, self._people)
            else:
                self._desk.take(command)
        except CorridorError as error:
            return str(error)
        return ""


class Server:
    """What answers browsers, on top of a watch, a desk and the browser of the memory."""

    def __init__(self, watch: Watch, desk: Desk, memory: Browser, address: Address) -> None:
        self._watch, self._desk, self._memory, self._address = watch, desk, memory, address
        self._registry = CollectorRegistry()
        self._registry.register(Figures(watch))
        routes = [
            WebSocketRoute("/updates", self._updates),
            Route("/metrics", self._metrics),
            *(Route(f"/memory/{a.__name__}", self._answering(a)) for a in memory.answers),
            Mount("/", StaticFiles(directory=STATIC, html=True)),
        ]
        self.app = Guard(Starlette(routes=routes), address.hosts)

    async def _updates(self, socket_: WebSocket) -> None:
        if self._watch.browsers >= MOST_BROWSERS:
            await socket_.close(1013)
            return
        await socket_.accept()
        self._watch.browsers += 1
        link = Link(self._watch, self._desk, self._address.token, socket_)
        try:
            async with anyio.create_task_group() as both:
                both.start_soon(link.send)
                both.start_soon(link.receive)
        except* (WebSocketDisconnect, TimeoutError) as ends:
            log.debug("a browser is gone: %s", ends.exceptions)
        finally:
            self._watch.browsers -= 1
        if socket_.client_state is WebSocketState.CONNECTED:
            await socket_.close()

    async def _metrics(self, _: Request) -> Response:
        return Response(generate_latest(self._registry), media_type=CONTENT_TYPE_LATEST)

    def _answering(self, answer: Answer) -> Callable[[Request], Awaitable[Response]]:
        async def respond(request: Request) -> Response:
            try:
                return JSONResponse(await self._memory.ask(answer, dict(request.query_params)))
            except ValidationError as error:
                return JSONResponse({"error": first_problem(error)}, 400)
            except (CorridorError, KeyError) as error:
                return JSONResponse({"error": str(error).strip("'\"")}, 404)

        return respond

    def serve(self, place: socket.socket) -> None:
        """Answer until SIGTERM or Ctrl-C."""
        config = uvicorn.Config(self.app, log_config=None, access_log=False, lifespan="off")
        config.ws, config.ws_max_size = "websockets-sansio", 2 * MOST_BYTES
        config.limit_concurrency, config.timeout_graceful_shutdown = 128, 1
        config.ws_per_message_deflate = False  # it would cost more than all the rest
        uvicorn.Server(config).run([place])
