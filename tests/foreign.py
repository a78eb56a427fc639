"""A foreign program's whole Zenoh layer: raw keys, msgpack, plain dictionaries, nothing of ours."""

from __future__ import annotations

import json
import queue
import time
from typing import Any

import msgpack
import zenoh

DEADLINE_S = 60.0


def pack(name: str, /, **fields: Any) -> bytes:
    return msgpack.packb({"v": 3, "t": name, **fields})


class Client:
    """A foreign program on the bus of a run.

    Args:
        endpoint: The router's.
        run: Name of the run.
        credentials: Folder with its certificate, for a guarded router.
    """

    def __init__(self, endpoint: str, run: str, credentials: str = "") -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("scouting/multicast/enabled", "false")
        if credentials:  # as docs/security.md says
            endpoint = endpoint.replace("tcp/", "tls/")
            files = {"root_ca_certificate": "ca", "connect_certificate": "cert"}
            tls: dict[str, Any] = {
                name: f"{credentials}/{file}.pem"
                for name, file in {**files, "connect_private_key": "key"}.items()
            }
            config.insert_json5("transport/link/tls", json.dumps({**tls, "enable_mtls": True}))
            config.insert_json5("transport/shared_memory/enabled", "false")
        config.insert_json5("connect/endpoints", json.dumps([endpoint]))
        self.session, self.run = zenoh.open(config), run

    def put(self, key: str, payload: bytes) -> None:
        self.session.put(
            f"{self.run}/{key}", payload, congestion_control=zenoh.CongestionControl.BLOCK
        )

    def subscribe(self, key: str) -> queue.Queue[dict[str, Any]]:
        received: queue.Queue[dict[str, Any]] = queue.Queue()
        self.session.declare_subscriber(
            f"{self.run}/{key}", lambda s: received.put(msgpack.unpackb(s.payload.to_bytes()))
        )
        return received

    def ask(self, key: str, payload: bytes) -> list[dict[str, Any]]:
        """All answers to one request; asked again while nobody serves it."""
        deadline_s = time.monotonic() + DEADLINE_S
        while time.monotonic() < deadline_s:
            replies = self.session.get(
                f"{self.run}/{key}",
                zenoh.handlers.FifoChannel(64),
                payload=payload,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=10.0,
            )
            answers = [msgpack.unpackb(r.ok.payload.to_bytes()) for r in replies if r.ok]
            if answers:
                return answers
        raise AssertionError(f"nobody answers {key}")

    def ask_all(self, key: str, payload: bytes) -> dict[str, dict[str, Any]]:
        """The answers of all lives, by service and id."""
        replies = self.session.get(
            f"{self.run}/{key}",
            zenoh.handlers.FifoChannel(64),
            payload=payload,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=10.0,
        )
        answers = [msgpack.unpackb(r.ok.payload.to_bytes()) for r in replies if r.ok]
        return {f"{answer['service']}-{answer['id']}": answer for answer in answers}

    def refusals(self, key: str, payload: bytes) -> list[dict[str, Any]]:
        """Error replies to one request."""
        replies = self.session.get(f"{self.run}/{key}", payload=payload, timeout=10.0)
        return [msgpack.unpackb(r.err.payload.to_bytes()) for r in replies if r.err]


def wait_for(received: queue.Queue[dict[str, Any]], **fields: Any) -> dict[str, Any]:
    """The next message with these field values."""
    deadline_s = time.monotonic() + DEADLINE_S
    while True:
        message = received.get(timeout=max(deadline_s - time.monotonic(), 0.01))
        if all(message[name] == value for name, value in fields.items()):
            return message
