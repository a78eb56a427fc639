"""Messages filled with plain values, and a stand-in for a service that answers requests."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import NoneType
from typing import Any, Literal, TypeVar, get_args, get_origin

from shared.bus import Bus
from shared.config import BusConfig, Config
from shared.halts.book import HaltBook, means
from shared.keys import HALT, PING, RELEASE, STOP, Stream
from shared.messages import PROTOCOL_VERSION, Halts, Message, Release, ServiceReply, Standing
from shared.service import new_life

M = TypeVar("M", bound=Message)
TEXTS = {"life": "0" * 12, "hash": "0" * 16, "config": "0" * 16, "lineage": "0" * 16}


def message(cls: type[M], **given: Any) -> M:
    """A message with the given fields; the other required ones get the plainest valid value."""
    values = {
        name: _plain(name, field.annotation, _least(field.metadata))
        for name, field in cls.model_fields.items()
        if field.is_required()
    }
    return cls(**{**values, **given})


def _least(metadata: list[Any]) -> int:
    """The shortest length a field allows."""
    return next((item.min_length for item in metadata if hasattr(item, "min_length")), 1)


def _plain(name: str, annotation: Any, least: int = 1) -> Any:
    if annotation is str:
        return next((text for end, text in TEXTS.items() if name.endswith(end)), "x")
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return arguments[0]
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return (_plain(name, arguments[0]),) * least
        return tuple(_plain(name, argument) for argument in arguments)
    if NoneType in arguments:
        return None
    if hasattr(annotation, "__metadata__"):
        return _plain(name, arguments[0])
    if isinstance(annotation, type) and issubclass(annotation, Message):
        return message(annotation)
    return annotation()


@contextmanager
def answering(
    config: BusConfig, run: str, ident: str, answer: Callable[[Message], Message], *streams: Stream
) -> Iterator[Bus]:
    """Answer every request of some streams from a thread while the block runs; yields the bus."""
    done = threading.Event()
    with Bus(config, run) as bus:
        inbox = bus.inbox()
        for stream in streams:
            inbox.serve(stream, ident)

        def serve() -> None:
            while not done.is_set():
                inbox.wait(0.05)
                for request in inbox.requests():
                    with request:
                        request.reply(answer(request.message))

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield bus
        finally:
            done.set()
            thread.join()


class FakeDriver:
    """Keeps a book of halts, as a driver does; refuses the first few."""

    def __init__(self, name: str, refusals: int) -> None:
        self.name, self.life = name, new_life()
        self.book, self.asked, self._refusals = HaltBook(name), 0, refusals

    def answer(self, request: Message) -> Standing:
        """Take up a halt or a release."""
        self.asked += 1
        if self.asked > self._refusals:
            if isinstance(request, Halts):
                self.book.add(request.halts)
            elif isinstance(request, Release) and means(request, self.life, 0.0):
                self.book.release(request.numbers, request.robot)
        kinds = self.book.kinds(self.name)
        return message(
            Standing,
            service="driver",
            id=self.name,
            life=self.life,
            clock_s=0.0,
            state="estop" if "estop" in kinds else "paused" if kinds else "waiting",
            stands=bool(kinds),
            halts=self.book.holding(self.name),
        )


@contextmanager
def fake_driver(config: Config, robot: str, *, refusals: int = 0) -> Iterator[FakeDriver]:
    """A driver that is visible and answers halts and releases; it may refuse the first few."""
    driver = FakeDriver(robot, refusals)
    run = config.run.name
    with answering(config.bus, run, "main", driver.answer, HALT, RELEASE) as bus:
        bus.announce("driver", robot, driver.life, PROTOCOL_VERSION, config.fingerprint())
        yield driver


@contextmanager
def fake_service(
    config: Config, service: str, ident: str, commands: list[Message]
) -> Iterator[Bus]:
    """A service that is visible and answers `ping` and `stop`; what came is put in `commands`."""
    reply = message(
        ServiceReply, service=service, id=ident, pid=1234, version="0.1.0", uptime_s=61.0
    )

    def answer(request: Message) -> Message:
        commands.append(request)
        return reply

    stream_id = f"{service}-{ident}"
    with answering(config.bus, config.run.name, stream_id, answer, PING, STOP) as bus:
        bus.announce(service, ident, "0" * 12, PROTOCOL_VERSION, config.fingerprint())
        yield bus
