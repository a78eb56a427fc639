"""P7: how fast bulk travels: snapshots, episodes and weights between real processes.

A router and the replay service run as processes of their own on a memory of 45,000 samples. Here
sit a learner's mirror that takes snapshots (shared memory on and off, in turns), an actor that
hands over episodes of 450 samples, and a learner that publishes new weights to a second process
which says when they are ready to predict.

    python -m benchmarks.transfer [--short | --check]
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks.frame import Bar, Mode, mode_of, report, rounds_of, table
from services.learner.mirror import Mirror
from services.monitor.supervisor import Supervisor
from services.monitor.up import child_specs, free_endpoint
from services.replay.storage import Storage
from shared import settings
from shared.bus import Bus
from shared.config import Config
from shared.errors import BusError, RouterMissing
from shared.keys import EPISODE, LEARNER_STATE, PROGRESS, WEIGHTS
from shared.messages import (
    Episode,
    EpisodeAck,
    LearnerState,
    ProgressRequest,
    RobotProgress,
)
from shared.rl.memory import ReplayMemory
from shared.rl.network import initialised, to_bytes, weights_hash
from shared.rl.retention import Discard
from shared.rl.turn import Maintenance
from shared.weights import parts

LIFE = "beec0ffeebee"
EPISODE_SAMPLES = 450
PATIENCE_S = 60.0
RECEIVER = """
import sys, time
from shared.config import Config
from shared.service import service
from shared.weights import WeightsFetcher
from shared.rl.predictor import Predictor
config = Config.model_validate_json(sys.argv[1])
with service("actor", "bench", config) as me:
    predictor = Predictor(config.network, config.numerics.actor)
    weights = WeightsFetcher(me, lambda: None)
    for version in range(1, int(sys.argv[2]) + 1):
        predictor.load(*weights.wait_for(version))
        print(predictor.version, time.monotonic(), flush=True)
"""


def make_episode(number: int, samples: int, *, fill: bool) -> Episode:
    """An episode with noise for images, which no shortcut can shrink."""
    rng = np.random.default_rng(number)
    return Episode(
        robot="bench",
        life=LIFE,
        number=number,
        fill=fill,
        ended="full",
        bump=False,
        weights_version=1,
        fitness=500,
        actions=samples,
        dropped_samples=0,
        dropped_episodes=0,
        worlds=("plus",),
        images=rng.bytes(samples * 3750),
        sample_actions=rng.integers(0, 3, samples, np.uint8).tobytes(),
        sample_rewards=rng.uniform(-0.9, 0.9, samples).astype("<f4").tobytes(),
        sample_steps=np.arange(samples, dtype="<u4").tobytes(),
        sample_episodes=np.full(samples, number, "<u4").tobytes(),
        sample_versions=np.ones(samples, "<u4").tobytes(),
        sample_worlds=bytes(samples),
        positions=bytes(12 * samples),
        robot_life=LIFE,
        last_sequence=number * samples,
    )


def fill(folder: Path, config: Config) -> int:
    """Write a full memory the way replay does; the number of submissions made."""
    identity = f"{config.run.name}/{config.run.seed}"
    storage = Storage(folder / "replay", config.memory, identity)
    memory, number = ReplayMemory(config.memory.capacity), 0
    while len(memory) < config.memory.capacity:
        storage.commit(make_episode(number, EPISODE_SAMPLES, fill=True))
        pending = storage.pending(number)
        assert pending is not None
        memory.worlds = storage.worlds()
        memory.append(*storage.rows_of(pending[0]))
        storage.apply_turn(*pending, memory, Maintenance(Discard(), equalised=False))
        number += 1
    storage.close()
    return number


@contextmanager
def system(config: Config, folder: Path) -> Iterator[Config]:
    """Router and replay as processes; the configuration that reaches them."""
    stored = settings.claim(folder, config)
    specs = child_specs(config, stored, folder, config.bus.endpoint)
    (folder / "logs").mkdir(exist_ok=True)
    wanted = [spec for spec in specs if spec.name in ("router", "replay")]
    with Supervisor(wanted, folder / "logs", dict(os.environ), []):
        yield config


def bus(config: Config, *, shared_memory: bool = True) -> Bus:
    """A client, as soon as the router answers and replay serves."""
    chosen = config.bus.model_copy(update={"shared_memory": shared_memory})
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            client = Bus(chosen, config.run.name)
            client.request(PROGRESS, ProgressRequest(robot="bench"), RobotProgress)
            return client
        except BusError as error:
            if not isinstance(error, RouterMissing):
                client.close()
            if time.monotonic() > deadline_s:
                raise


def snapshot_rate(client: Bus) -> float:
    """MB/s of a snapshot, until the mirror could train on it."""
    mirror = Mirror()
    start_s = time.perf_counter()
    mirror.reach(client, 1)
    return len(mirror.samples) * 3750 / 1e6 / (time.perf_counter() - start_s)


def acknowledged(client: Bus, first: int, count: int) -> list[float]:
    """Seconds from sending an episode of 450 samples to its acknowledgement, `count` times."""
    spent = []
    for number in range(first, first + count):
        episode = make_episode(number, EPISODE_SAMPLES, fill=False)
        start_s = time.perf_counter()
        ack = client.request(EPISODE, episode, EpisodeAck, timeout_s=30.0)
        spent.append(time.perf_counter() - start_s)
        assert ack.accepted, ack.reason
    return spent


def ready(client: Bus, config: Config, versions: int) -> list[float]:
    """Seconds from publishing a new version to its being ready in another process."""
    network = initialised(config.network, 1)
    data = to_bytes(network)
    inbox = client.inbox()
    inbox.serve(WEIGHTS)
    command = [sys.executable, "-c", RECEIVER, config.model_dump_json(), str(versions)]
    spent = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as receiver:
        assert receiver.stdout is not None
        for version in range(1, versions + 1):
            published_s = time.monotonic()
            client.publish(LEARNER_STATE, learner_state(version, data))
            spent.append(_served(inbox, version, data, receiver.stdout.fileno()) - published_s)
    return spent[1:]  # the first includes the start of the process


def _served(inbox: object, version: int, data: bytes, descriptor: int) -> float:
    """Answer for weights until the receiver reports this version; when it was ready."""
    from select import select

    while True:
        inbox.wait(0.002)  # type: ignore[attr-defined]
        for request in inbox.requests():  # type: ignore[attr-defined]
            with request:
                for part in parts(version, data):
                    request.reply(part)
        if select([descriptor], [], [], 0)[0]:
            said = os.read(descriptor, 200).split()
            return float(said[-1])


def learner_state(version: int, data: bytes) -> LearnerState:
    """The announcement of a version."""
    return LearnerState(
        id="main",
        life=LIFE,
        episode=0,
        weights_version=version,
        weights_hash=weights_hash(data),
        activity="waiting",
        loss=None,
        train_steps=0,
        fits=0,
        target_age=0,
        resyncs=0,
        undecodable=0,
    )


def measure(mode: Mode) -> list[Bar]:
    """All figures of P7 but the acknowledgement during a pass, which needs a trained system."""
    capacity = {"check": 900, "short": 45_000, "full": 45_000}[mode]
    filters = 4 if mode == "check" else 64
    config = Config.model_validate(
        {
            "run": {"name": "bench"},
            "bus": {"endpoint": free_endpoint()},
            "memory": {"capacity": capacity, "strategy": "normm", "equalise_every": 0},
            "network": {"filters": filters},
        }
    )
    rounds, acks = rounds_of(mode, 5, 15), rounds_of(mode, 50, 200)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "run"
        first = fill(folder, config)
        with system(config, folder), bus(config) as on, bus(config, shared_memory=False) as off:
            rates: dict[bool, list[float]] = {True: [], False: []}
            for _ in range(rounds):
                rates[False].append(snapshot_rate(off))
                rates[True].append(snapshot_rate(on))
            spent = acknowledged(on, first, acks)
            delays = ready(on, config, rounds_of(mode, 20, 50))
    return [
        _rate("P7a", rates[False], 250, 400),
        _rate("P7b", rates[True], 700, 1200),
        _delay("P7c", delays, 250, 100),
        _delay("P7d", spent, 60, 25),
    ]


def _rate(name: str, rates: list[float], required: float, aim: float) -> Bar:
    value = median(rates)
    return Bar(name, value, "MB/s", "higher", required, aim, None, value, len(rates))


def _delay(name: str, spent: list[float], required: float, aim: float) -> Bar:
    value = float(np.percentile(spent, 95)) * 1e3
    own = median(spent) * 1e3
    return Bar(name, value, "ms p95", "lower", required, aim, None, own, len(spent))


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and report."""
    bars = measure(mode_of(arguments, __doc__))
    what = {
        "P7a": "snapshot, shared memory off",
        "P7b": "snapshot, shared memory on",
        "P7c": "weights published until ready",
        "P7d": "episode of 450 until on disk",
    }
    rows = [[what[bar.id], bar.value, bar.unit, bar.n] for bar in bars]
    report("Bulk transfer", [table(["what", "value", "unit", "n"], rows)], bars)


if __name__ == "__main__":
    main()
