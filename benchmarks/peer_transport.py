"""P8: weights from one process to another: ours against gRPC streaming chunks of 2 MB.

gRPC as robot learning ships weights with it: the receiver holds one stream open, the sender pushes
every version as chunks of 2 MB, each marked as first, middle or last, straight over TCP. Ours is
announced, asked for through the router, and checked against its hash when it has come; bytes only
count as received then. Both receivers are processes of their own; versions go out in turns.

    python -m benchmarks.peer_transport [--short | --check]
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from queue import SimpleQueue
from statistics import median
from typing import IO

from benchmarks import frames, peers
from benchmarks.distribution import connected
from benchmarks.frame import Bar, Mode, Times, mode_of, report, rounds_of, speedup, table
from benchmarks.transfer import learner_state
from services.launcher.supervisor import Supervisor
from services.launcher.up import child_specs, free_endpoint
from shared import settings
from shared.bus import Bus
from shared.config import Config
from shared.inbox import Inbox
from shared.keys import LEARNER_STATE, WEIGHTS
from shared.rl.network import initialised, to_bytes
from shared.weights import parts

CHUNK_BYTES = 2 * 1024 * 1024
LARGEST_BYTES = 4 * 1024 * 1024
"""Most bytes of one gRPC message: a chunk with its head."""
SERVICE, METHOD = "corridor.Learner", "StreamWeights"
FIRST, MIDDLE, LAST = b"\x01", b"\x02", b"\x03"
PAUSE_S = 0.02
PEER = "gRPC"
OURS_RECEIVER = """
import sys, time
from shared.config import Config
from shared.service import service
from shared.weights import WeightsFetcher
config = Config.model_validate_json(sys.argv[1])
with service("actor", "bench", config) as me:
    weights = WeightsFetcher(me, lambda: None)
    print(0, 0, flush=True)
    for version in range(1, int(sys.argv[2]) + 1):
        newest, data = weights.wait_for(version)
        print(len(data), time.monotonic(), flush=True)
"""
GRPC_RECEIVER = """
import sys
from benchmarks.peer_transport import receive
receive(sys.argv[1], int(sys.argv[2]))
"""


class GrpcSender:
    """A gRPC server with one method, which streams the chunks of every version published."""

    def __init__(self) -> None:
        from concurrent.futures import ThreadPoolExecutor

        import grpc

        self._data = b""
        self._versions: SimpleQueue[bytes | None] = SimpleQueue()
        self._server = grpc.server(ThreadPoolExecutor(max_workers=4), options=limits())
        handler = grpc.unary_stream_rpc_method_handler(self._stream)
        self._server.add_generic_rpc_handlers(
            [grpc.method_handlers_generic_handler(SERVICE, {METHOD: handler})]
        )
        self.port = self._server.add_insecure_port("127.0.0.1:0")
        self._server.start()

    def prepare(self, data: bytes) -> None:
        """Have a version at hand."""
        self._data = data

    def publish(self) -> None:
        """Send the version to the receiver."""
        self._versions.put(self._data)

    def close(self) -> None:
        """End the stream and the server."""
        self._versions.put(None)
        self._server.stop(grace=1.0).wait()

    def _stream(self, request: bytes, context: object) -> Iterator[bytes]:  # noqa: ARG002
        while (data := self._versions.get()) is not None:
            yield from chunks(data)


def limits() -> list[tuple[str, int]]:
    """Options that let a chunk pass."""
    return [
        ("grpc.max_receive_message_length", LARGEST_BYTES),
        ("grpc.max_send_message_length", LARGEST_BYTES),
    ]


def chunks(data: bytes) -> Iterator[bytes]:
    """Bytes cut into messages: a mark, then at most 2 MB."""
    for start in range(0, len(data), CHUNK_BYTES):
        last = start + CHUNK_BYTES >= len(data)
        mark = LAST if last else MIDDLE if start else FIRST
        yield mark + data[start : start + CHUNK_BYTES]


def receive(address: str, versions: int) -> None:
    """Take versions off the stream; print the size of each and when it was there."""
    import grpc

    with grpc.insecure_channel(address, options=limits()) as channel:
        stream = channel.unary_stream(f"/{SERVICE}/{METHOD}")(b"")
        print(0, 0, flush=True)
        for _ in range(versions):
            print(len(joined(stream)), time.monotonic(), flush=True)


def joined(stream: Iterator[bytes]) -> bytes:
    """One version from its chunks."""
    received = []
    for chunk in stream:
        received.append(memoryview(chunk)[1:])
        if chunk[:1] == LAST:
            return b"".join(received)
    raise EOFError(f"the stream ended after {len(received)} chunks")


class OurSender:
    """The learner's side of the bus: announces versions and answers who asks for them."""

    def __init__(self, client: Bus) -> None:
        self._client, self._data = client, b""
        self._state = learner_state(0, b"")
        self._inbox: Inbox = client.inbox()
        self._inbox.serve(WEIGHTS)
        self._ended = False
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def prepare(self, data: bytes) -> None:
        """Have a version and its hash at hand, as a learner has before it announces one."""
        self._data, self._state = data, learner_state(self._state.weights_version + 1, data)

    def publish(self) -> None:
        """Announce the version."""
        self._client.publish(LEARNER_STATE, self._state)

    def close(self) -> None:
        """Answer no more."""
        self._ended = True
        self._inbox.wake()
        self._thread.join()

    def _serve(self) -> None:
        while not self._ended:
            self._inbox.wait(0.2)
            for request in self._inbox.requests():
                with request:
                    for part in parts(
                        self._state.weights_version, self._data, self._state.weights_hash
                    ):
                        request.reply(part)


@contextmanager
def router(folder: Path, mode: Mode) -> Iterator[Config]:
    """A router process; the configuration that reaches it."""
    bus = {"endpoint": free_endpoint()}
    network = frames.network_config(mode).model_dump()
    config = Config.model_validate({"run": {"name": "bench"}, "bus": bus, "network": network})
    stored = settings.claim(folder, config)
    specs = child_specs(config, stored, folder, config.bus.endpoint)
    (folder / "logs").mkdir(exist_ok=True)
    wanted = [spec for spec in specs if spec.name == "router"]
    with Supervisor(wanted, folder / "logs", dict(os.environ), []):
        yield config


@contextmanager
def receiver(code: str, address: str, versions: int) -> Iterator[IO[str]]:
    """What a receiving process says: a line when it is ready, and one for each version."""
    command = [sys.executable, "-c", code, address, str(versions)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        yield process.stdout


def delay_s(sender: GrpcSender | OurSender, said: IO[str], data: bytes) -> float:
    """Seconds from publishing a version until the other process has it."""
    sender.prepare(data)
    time.sleep(PAUSE_S)
    published_s = time.monotonic()
    sender.publish()
    size, received_s = said.readline().split()
    assert int(size) == len(data)
    return float(received_s) - published_s


def measure(mode: Mode) -> Times:
    """Seconds from published to received, both sides in turns."""
    data = to_bytes(initialised(frames.network_config(mode), frames.SEED))
    warm_up, rounds = 5, rounds_of(mode, short=60, full=300)
    times: Times = {PEER: [], "ours": []}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "run"
        config = stack.enter_context(router(folder, mode))
        own = OurSender(stack.enter_context(connected(config)))
        stack.callback(own.close)
        peer = GrpcSender()
        stack.callback(peer.close)
        versions = warm_up + rounds
        address = f"127.0.0.1:{peer.port}"
        grpc_says = stack.enter_context(receiver(GRPC_RECEIVER, address, versions))
        our_says = stack.enter_context(receiver(OURS_RECEIVER, config.model_dump_json(), versions))
        for number in range(versions):
            spent = {PEER: delay_s(peer, grpc_says, data), "ours": delay_s(own, our_says, data)}
            for name in times if number >= warm_up else ():
                times[name].append(spent[name])
    return times


def bar(times: Times) -> Bar:
    """P8d: how many times faster ours is there."""
    return speedup("P8d", times[PEER], times["ours"], required=1.0, aim=1.0)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and report."""
    mode = mode_of(arguments, __doc__)
    peers.require(__file__, "grpc")
    times = measure(mode)
    rows = [
        [name, median(spent) * 1e3, min(spent) * 1e3, max(spent) * 1e3]
        for name, spent in times.items()
    ]
    head = ["weights by", "median ms", "best ms", "worst ms"]
    report("P8 weights beside gRPC", [table(head, rows)], [bar(times)])


if __name__ == "__main__":
    main()
