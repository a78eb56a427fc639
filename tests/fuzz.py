"""Damaged payloads for everything that reads bytes of others: no crash, no hang, little memory.

    python -m tests.fuzz [--count N] [--seed N] [--target NAME]

Each payload is a good one, changed: as a tree of values where it has a structure, else byte by
byte. A reader may take it, or refuse it by the error that its users expect. Anything else is
printed with its seed, and the payload is kept in `tests/corpus`, which the tests read again.
"""

from __future__ import annotations

import argparse
import faulthandler
import io
import json
import random
import resource
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from PIL import Image

from services.robot_driver.real import cdr, picture, robotino_replies, ros2_names
from services.robot_driver.real.http_call import Connection, _Socket
from services.robot_driver.real.link import Battery
from services.robot_driver.robot import Pose, Velocity
from shared import codec, messages, weights
from shared.config import NetworkConfig
from shared.errors import BadMessage
from shared.rl.network import QNetwork, checked, initialised, to_bytes
from tests.builders import make_episode, make_observation
from tests.fakes import message

CORPUS = Path(__file__).parent / "corpus"
HANG_S = 10.0
MEMORY_MIB = 400
"""More than what is there at the beginning is too much."""
ODD = (0, 1, -1, 2**31, 2**32, 2**63 - 1, -(2**63), 2**64 - 1, 1e308, -1e39, float("nan"),
       float("inf"), "", "x" * 5000, "\x1b[31m", "../..", b"", b"\x80" * 300, None, True, (), {},
       ((),) * 50, {"v": 3})  # fmt: skip


@dataclass(frozen=True)
class Target:
    """One reader, its good payloads, and the errors it may raise."""

    read: Callable[[bytes], object]
    good: tuple[bytes, ...]
    errors: tuple[type[Exception], ...]
    mutate: Callable[[bytes, random.Random], bytes]


# ---------------------------------------------------------------- changes


def bytewise(data: bytes, draw: random.Random) -> bytes:
    """A few bytes changed, cut off, inserted, repeated or moved."""
    changed = bytearray(data)
    for _ in range(draw.choice((1, 1, 2, 4, 8))):
        at = draw.randrange(len(changed) + 1)
        end = min(len(changed), at + draw.choice((1, 2, 4, 8, 64)))
        kind = draw.randrange(6)
        if kind == 0 and at < len(changed):
            changed[at] ^= 1 << draw.randrange(8)
        elif kind == 1:
            changed[at:end] = draw.randbytes(end - at)
        elif kind == 2:
            del changed[at : draw.choice((end, len(changed)))]
        elif kind == 3:
            changed[at:at] = draw.choice((b"\x00", b"\xff", b"\x7f", b"\x80")) * draw.choice(
                (1, 4, 8)
            )
        elif kind == 4:
            changed[at:at] = changed[at:end] * draw.choice((1, 3))
        else:
            changed[at:end] = draw.choice((0, 1, 2**31 - 1, 2**32 - 1)).to_bytes(4, "little")
    return bytes(changed)


def structured(load: Callable[[bytes], Any], dump: Callable[[Any], bytes]) -> Any:
    """Changes of the tree of values that the bytes stand for, and now and then of bytes."""

    def mutate(data: bytes, draw: random.Random) -> bytes:
        if draw.random() < 0.3:
            return bytewise(data, draw)
        tree = load(data)
        for _ in range(draw.choice((1, 1, 2, 3))):
            tree = _changed(tree, draw)
        with suppress(OverflowError, ValueError, TypeError):
            return dump(tree)
        return data

    return mutate


def _changed(value: Any, draw: random.Random) -> Any:
    """The tree with one part replaced, left out or added."""
    if isinstance(value, dict) and value and draw.random() < 0.9:
        key = draw.choice(list(value))
        kind = draw.randrange(8)
        if kind == 0:
            return {k: v for k, v in value.items() if k != key}
        if kind == 1:
            return {**value, "more": draw.choice(ODD)}
        return {**value, key: _changed(value[key], draw)}
    if isinstance(value, (list, tuple)) and value and draw.random() < 0.8:
        at = draw.randrange(len(value))
        items = list(value)
        kind = draw.randrange(6)
        items[at : at + 1] = (
            []
            if kind == 0
            else items[at : at + 1] * 40
            if kind == 1
            else [_changed(items[at], draw)]
        )
        return items
    if isinstance(value, bytes) and value and draw.random() < 0.5:
        return bytewise(value, draw)
    if isinstance(value, float) and draw.random() < 0.3:
        return value * draw.choice((-1.0, 1e-300, 1e6, 1e30))
    if isinstance(value, int) and draw.random() < 0.3:
        return value + draw.choice((-1, 1, 255, 2**16))
    return draw.choice(ODD)


# ---------------------------------------------------------------- readers


def _messages() -> Iterator[tuple[str, Target]]:
    mutate = structured(
        lambda data: msgpack.unpackb(data, strict_map_key=False),
        lambda tree: bytes(msgpack.packb(tree)),
    )
    whole: dict[str, messages.Message] = {  # values that belong together
        "Observation": make_observation(3),
        "Episode": make_episode(4),
        "WorldChange": messages.WorldChange(kind="remove", name="box"),
        "Weights": next(weights.parts(3, b"w" * 100, "0" * 16)),
        "MiniBatchRequest": messages.MiniBatchRequest(size=2, key=1),
        "Change": messages.Change(number=2, last=True, kind="discard", ids=bytes(8)),
    }
    for cls in vars(messages).values():
        if (
            isinstance(cls, type)
            and issubclass(cls, messages.Message)
            and cls is not messages.Message
        ):
            good = codec.encode(whole.get(cls.__name__) or message(cls))
            read = lambda data, cls=cls: codec.decode(data, cls)  # noqa: E731
            yield f"message {cls.__name__}", Target(read, (good,), (BadMessage,), mutate)


def _ros2() -> Iterator[tuple[str, Target]]:
    rgb = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)
    pose, velocity = Pose(1.0, 2.0, 0.5), Velocity(0.2, 0.0, 0.1)
    image = cdr.encode_image(rgb, 5)
    images = (image, image.replace(b"rgb8", b"bgr8"))
    readers: dict[str, tuple[Callable[[bytes], object], tuple[bytes, ...]]] = {
        "odometry": (cdr.decode_odometry, (cdr.encode_odometry(pose, velocity, 5),)),
        "image": (lambda data: cdr.decode_camera(data, "Image"), images),
        "compressed image": (
            lambda data: cdr.decode_camera(data, "CompressedImage"),
            (cdr.encode_compressed_image(_jpeg(), 5),),
        ),
        "hazards": (
            lambda data: cdr.decode_bumper(data, "HazardDetectionVector"),
            (cdr.encode_bumper(True, "HazardDetectionVector", 5),),
        ),
        "bool": (lambda data: cdr.decode_bumper(data, "Bool"), (cdr.encode_bumper(True, "Bool"),)),
        "battery": (
            lambda data: cdr.decode_battery(data, "BatteryState"),
            (cdr.encode_battery(Battery(False, 12.0), "BatteryState", 5),),
        ),
        "power": (
            lambda data: cdr.decode_battery(data, "PowerReadings"),
            (cdr.encode_battery(Battery(True, 12.0), "PowerReadings", 5),),
        ),
    }
    for name, (read, good) in readers.items():
        yield f"ros2 {name}", Target(read, good, (BadMessage,), bytewise)
    attachment = ros2_names.packed(ros2_names.Attachment(3, 5, b"g" * 16))
    yield "ros2 attachment", Target(ros2_names.unpacked, (attachment,), (), bytewise)
    endpoint = ros2_names.Endpoint("listens", "cmd_vel", "geometry_msgs/msg/Twist")
    token = ros2_names.bridge_token("ab12", endpoint).encode()
    yield (
        "ros2 token",
        Target(
            lambda data: ros2_names.parsed_token(data.decode(errors="replace"), 0),
            (token,),
            (),
            bytewise,
        ),
    )


def _pictures() -> Iterator[tuple[str, Target]]:
    def of(form: str, **options: Any) -> bytes:
        stream = io.BytesIO()
        mode = options.pop("mode", "RGB")
        Image.fromarray(_noise()).convert(mode).save(stream, form, **options)
        return stream.getvalue()

    jpegs = (
        of("JPEG"),
        of("JPEG", progressive=True),
        of("JPEG", mode="L"),
        of("JPEG", mode="CMYK"),
    )
    yield "picture jpeg", Target(picture.decoded, jpegs, (BadMessage,), bytewise)
    yield (
        "picture png",
        Target(picture.decoded, (of("PNG"), of("PNG", mode="P")), (BadMessage,), bytewise),
    )


def _replies() -> Iterator[tuple[str, Target]]:
    mutate = structured(json.loads, lambda tree: json.dumps(tree).encode())
    for name, reader, good in (
        ("odometry", robotino_replies.odometry, b"[0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 17]"),
        ("bumper", robotino_replies.bumper, b'{"value": false}'),
        ("battery", robotino_replies.battery, b'{"batteryLow": false, "voltage": 24.1}'),
    ):
        yield f"reply {name}", Target(reader, (good,), (BadMessage,), mutate)
    head = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n"
    plain = head + b"Content-Length: 16\r\n\r\n" + b'{"value": false}'
    chunked = head + b"Transfer-Encoding: chunked\r\n\r\n5\r\n[1, 2\r\n3\r\n, 3\r\n0\r\n\r\n"
    yield "http", Target(_call, (plain, chunked), (OSError, HTTPException), bytewise)


class _Fed(Connection):
    """A connection whose answer is there already."""

    def __init__(self, answer: bytes) -> None:
        super().__init__("127.0.0.1:9", 1.0)
        self._answer = answer

    def connect(self) -> None:
        """Take one end of a pair; the other has said all it will."""
        ours, theirs = socket.socketpair()
        self.sock = _Socket(fileno=ours.detach())
        with theirs:
            theirs.sendall(self._answer)
            theirs.shutdown(socket.SHUT_WR)
            theirs.setblocking(False)


def _call(data: bytes) -> object:
    connection = _Fed(data)
    try:
        return connection.call("GET", "/data/bumper", None, 4096, whole=True)
    finally:
        connection.close()


def _weights() -> Iterator[tuple[str, Target]]:
    config = NetworkConfig(filters=4)
    network = QNetwork(config)
    good = to_bytes(initialised(config, seed=1))
    yield "weights", Target(lambda data: checked(network, data), (good,), (ValueError,), bytewise)


def _noise() -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)


def _jpeg() -> bytes:
    stream = io.BytesIO()
    Image.fromarray(_noise()).save(stream, "JPEG")
    return stream.getvalue()


def targets() -> dict[str, Target]:
    """All readers by name."""
    return dict(
        pair for part in (_messages, _ros2, _pictures, _replies, _weights) for pair in part()
    )


# ---------------------------------------------------------------- runs


def attempt(target: Target, data: bytes) -> str:
    """Let a reader read; returns what is wrong with that, empty if nothing is."""
    start_s = time.monotonic()
    try:
        target.read(data)
    except target.errors:
        pass
    except Exception as error:  # noqa: BLE001 - that is what is looked for
        return f"{type(error).__name__}: {error}"
    spent_s = time.monotonic() - start_s
    return f"took {spent_s:.1f} s" if spent_s > HANG_S else ""


def fuzz(count: int, seed: int, only: str = "", tell: Callable[[str], None] = print) -> int:
    """Try so many payloads over all readers by turns; returns how many found something."""
    chosen = {name: target for name, target in targets().items() if only in name}
    names, found = list(chosen), 0
    before_mib = _memory_mib()
    faulthandler.dump_traceback_later(HANG_S * 3, repeat=True, exit=True)
    for number in range(count):
        name = names[number % len(names)]
        draw = random.Random(f"{seed} {number}")
        data = chosen[name].mutate(draw.choice(chosen[name].good), draw)
        if wrong := attempt(chosen[name], data):
            found += 1
            CORPUS.mkdir(exist_ok=True)
            (CORPUS / f"{name.replace(' ', '-')}-{seed}-{number}").write_bytes(data)
            tell(f"{name}, seed {seed}, number {number}: {wrong}")
        if number % 1000 == 0:
            faulthandler.dump_traceback_later(HANG_S * 3, repeat=True, exit=True)
    faulthandler.cancel_dump_traceback_later()
    grown_mib = _memory_mib() - before_mib
    if grown_mib > MEMORY_MIB:
        found += 1
    tell(
        f"{count} payloads for {len(names)} readers, {found} found something, {grown_mib} MiB more"
    )
    return found


def _memory_mib() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


def main(arguments: Sequence[str] | None = None) -> int:
    """Fuzz; returns 1 if something was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--target", default="", help="only readers whose name contains this")
    given = parser.parse_args(arguments)
    return 1 if fuzz(given.count, given.seed, given.target) else 0


if __name__ == "__main__":
    sys.exit(main())
