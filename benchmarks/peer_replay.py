"""P8: a replay memory over a socket: ours against torchrl's remote replay buffer.

Both serve from a process of their own and are reached over TCP (shared memory off): episodes of
450 samples are inserted, then mini-batches of 128 drawn, in turns. The payload is the same images,
actions and rewards. What differs: an episode of ours is on disk, its identity and provenance with
it, when it is acknowledged, and passes a router; torchrl's is in a memory-mapped file that nobody
has written out. Ours draws without replacement from one consistent state, torchrl's with.

    python -m benchmarks.peer_replay [--short | --check]
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks import peers
from benchmarks.frame import (
    Bar,
    Mode,
    Times,
    interleaved,
    mode_of,
    report,
    rounds_of,
    speedup,
    times_table,
)
from benchmarks.transfer import EPISODE_SAMPLES, PATIENCE_S, bus, make_episode, system
from services.launcher.up import free_endpoint
from shared.bus import Bus
from shared.config import Config
from shared.facts import IMAGE_SHAPE
from shared.keys import EPISODE, MINI_BATCH
from shared.messages import Change, Episode, EpisodeAck, MiniBatchRequest

if TYPE_CHECKING:
    from benchmarks.peer_torchrl import Client

MINI_BATCH_SIZE = 128
WARM_UP = 5
PAUSE_S = 0.03
"""Pause before each insertion, so that the other side is done with the one before."""
PEER = "torchrl"
NOTE = (
    "Ours is on disk when acknowledged, with identity and provenance, and passes a router; "
    "torchrl's is in a memory-mapped file, not written out. Ours draws without replacement from "
    "one state of the memory, by key; torchrl's with replacement. Both over TCP. Reverb's "
    "memory is not measured: it needs a TensorFlow that needs an older NumPy."
)


class Ours:
    """A client of our replay service."""

    def __init__(self, client: Bus) -> None:
        self._client, self._key = client, 0

    def insert(self, episode: Episode) -> None:
        """Send samples; they are on disk when this returns."""
        ack = self._client.request(
            EPISODE, episode, EpisodeAck, ident=episode.robot, timeout_s=30.0
        )
        assert ack.accepted, ack.reason
        assert ack.stored == episode.count

    def sample(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Images, actions and rewards of a mini-batch."""
        drawn = self._draw()
        images = np.frombuffer(drawn.images, np.uint8).reshape(-1, *IMAGE_SHAPE)
        return (images, np.frombuffer(drawn.actions, np.uint8), np.frombuffer(drawn.rewards, "<f4"))

    def wait_for(self, change: int) -> None:
        """Wait until the memory has this change: until then turns are made."""
        deadline_s = time.monotonic() + PATIENCE_S
        while self._draw().number < change:
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"change {change} did not come within {PATIENCE_S:.0f} s")
            time.sleep(0.05)

    def _draw(self) -> Change:
        self._key += 1
        request = MiniBatchRequest(size=MINI_BATCH_SIZE, key=self._key)
        return self._client.request(MINI_BATCH, request, Change, timeout_s=30.0)


@contextmanager
def ours(folder: Path, capacity: int) -> Iterator[Ours]:
    """A client of a router and a replay service that live as long as the block."""
    config = Config.model_validate(
        {
            "run": {"name": "bench"},
            "bus": {"endpoint": free_endpoint()},
            "memory": {"capacity": capacity, "strategy": "normm", "equalise_every": 0},
        }
    )
    with system(config, folder), bus(config, shared_memory=False) as client:
        yield Ours(client)


def measure(mode: Mode) -> tuple[list[str], list[Bar]]:
    """Times of inserting and sampling: the tables, and the bars P8b and P8c."""
    from benchmarks.peer_torchrl import connected

    rounds = rounds_of(mode, short=60, full=95)
    capacity = 1_000_000  # never full: both only append
    with tempfile.TemporaryDirectory() as place:
        port = int(free_endpoint().rsplit(":", 1)[1])
        scratch = Path(place) / "torchrl"
        room = (rounds + WARM_UP) * EPISODE_SAMPLES
        with (
            ours(Path(place) / "run", capacity) as own,
            connected(scratch, port, room, MINI_BATCH_SIZE) as peer,
        ):
            inserting = inserted(peer, own, rounds)
            own.wait_for(rounds + WARM_UP)
            cases = {PEER: peer.sample, "ours": own.sample}
            sizes = {tuple(len(column) for column in case()) for case in cases.values()}
            assert sizes == {(MINI_BATCH_SIZE,) * 3}, sizes
            sampling = interleaved(cases, rounds_of(mode, short=60, full=200), WARM_UP)
    return described(inserting, sampling, room), [
        speedup("P8b", inserting[PEER], inserting["ours"], 1.0, 1.0),
        speedup("P8c", sampling[PEER], sampling["ours"], 1.0, 1.0),
    ]


def inserted(peer: Client, own: Ours, rounds: int) -> Times:
    """Seconds of inserting the same episodes into both, in turns."""
    from benchmarks.peer_torchrl import as_tensors

    times: Times = {PEER: [], "ours": []}
    for number in range(WARM_UP + rounds):
        episode = make_episode(number, EPISODE_SAMPLES, fill=True)
        tensors = as_tensors(episode)
        insert: dict[str, Callable[[], object]] = {
            PEER: lambda tensors=tensors: peer.insert(tensors),
            "ours": lambda episode=episode: own.insert(episode),
        }
        for name, case in insert.items():
            time.sleep(PAUSE_S)
            spent = interleaved({name: case}, rounds=1, warm_up=0)
            times[name] += spent[name] if number >= WARM_UP else []
    return times


def described(inserting: Times, sampling: Times, samples: int) -> list[str]:
    """Tables of both, and what the two do differently."""
    first = f"inserting {EPISODE_SAMPLES} samples"
    second = f"drawing {MINI_BATCH_SIZE} of {samples} samples"
    return [
        f"{first}\n\n{times_table(inserting, PEER)}",
        f"{second}\n\n{times_table(sampling, PEER)}",
        NOTE,
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and report."""
    mode = mode_of(arguments, __doc__)
    peers.require(__file__, "tensordict", "torchrl")
    found, bars = measure(mode)
    report("P8 replay beside torchrl", found, bars)


if __name__ == "__main__":
    main()
