"""Messages filled with plain values, and a stand-in for a service that answers requests."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import NoneType
from typing import Any, Literal, TypeVar, get_args, get_origin

from shared.bus import Bus
from shared.config import BusConfig, Config
from shared.keys import SERVICE, Stream
from shared.messages import Message, ServiceReply

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
    return annotation()


@contextmanager
def answering(
    config: BusConfig, run: str, stream: Stream, ident: str, answer: Callable[[Message], Message]
) -> Iterator[Bus]:
    """Answer every request of one stream from a thread while the block runs; yields the bus."""
    done = threading.Event()
    with Bus(config, run) as bus:
        inbox = bus.inbox()
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
    with answering(config.bus, config.run.name, SERVICE, stream_id, answer) as bus:
        bus.announce(service, ident, "0" * 12, 1, config.fingerprint())
        yield bus
