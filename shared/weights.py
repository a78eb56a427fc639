"""Weights over the bus: cut into parts, fetched by version, verified by hash."""

from __future__ import annotations

from collections.abc import Iterator

from shared.bus import Bus
from shared.errors import BadMessage, PeerSilent
from shared.keys import WEIGHTS
from shared.messages import Weights, WeightsRequest
from shared.rl.network import weights_hash

PART_BYTES = 1024 * 1024


def parts(version: int, data: bytes) -> Iterator[Weights]:
    """One version of the target network as messages of about 1 MB."""
    chunks = [data[i : i + PART_BYTES] for i in range(0, len(data), PART_BYTES)]
    for part, chunk in enumerate(chunks):
        yield Weights(
            version=version, hash=weights_hash(data), part=part, parts=len(chunks), data=chunk
        )


def fetch(bus: Bus) -> tuple[int, bytes]:
    """The newest version and its safetensors bytes. Raises BusError or BadMessage."""
    received = list(bus.request_many(WEIGHTS, WeightsRequest(), Weights))
    first = received[0]
    data = b"".join(message.data for message in received)
    if [m.part for m in received] != list(range(first.parts)):
        raise PeerSilent(f"weights: expected {first.parts} parts, got {len(received)}")
    if {(m.version, m.hash) for m in received} != {(first.version, weights_hash(data))}:
        raise BadMessage(f"weights: parts of version {first.version} do not match their hash")
    return first.version, data
