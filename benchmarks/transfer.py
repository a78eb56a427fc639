"""P7: how fast bulk travels: snapshots, episodes and weights between real processes.

A router and the replay service run as processes of their own on a memory of 45,000 samples. Here
sit a learner's mirror that takes snapshots (shared memory on and off, in turns), an actor that
hands over episodes of 450 samples, and a learner that publishes new weights to a second process
which says when they are ready to predict. A second replay equalises its whole memory after every
episode; only acknowledgements count before and after which it told that it was doing so.

    python -m benchmarks.transfer [--short | --check]
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks.frame import Bar, Mode, mode_of, report, rounds_of, table
from benchmarks.prefilled import EPISODE_SAMPLES, LIFE, bus, fill, make_episode, system
from services.launcher.up import free_endpoint
from services.learner.mirror import Mirror
from shared import settings
from shared.bus import Bus
from shared.config import ActorNumerics, Config
from shared.facts import IMAGE_BYTES
from shared.inbox import Inbox
from shared.keys import EPISODE, LEARNER_STATE, REPLAY_STATE, WEIGHTS
from shared.messages import NO_LINEAGE, EpisodeAck, LearnerState, ReplayState
from shared.numerics import choose, settle_all
from shared.rl.network import initialised, to_bytes, weights_hash
from shared.weights import parts

PATIENCE_S = 120.0
SERVED = ("router", "replay")
PAUSE_S = 0.3
"""Between episodes within a pass, so that they fall into several passes."""
RECEIVER = """
import sys, time
from shared.config import Config
from shared.service import service
from shared.weights import WeightsFetcher
from services.actor.targets import Targets
config = Config.model_validate_json(sys.argv[1])
with service("actor", "bench", config) as me:
    targets = Targets(config.network, config.numerics.actor)
    weights = WeightsFetcher(me, lambda: None)
    for version in range(1, int(sys.argv[2]) + 1):
        predictor = targets.of(*weights.wait_for(version))
        print(predictor.version, time.monotonic(), flush=True)
"""


def snapshot_rate(client: Bus) -> float:
    """MB/s of a snapshot, until the mirror could train on it."""
    mirror = Mirror()
    start_s = time.perf_counter()
    mirror.reach(client, 0, NO_LINEAGE)  # a snapshot, of whatever there is
    return len(mirror.samples) * IMAGE_BYTES / 1e6 / (time.perf_counter() - start_s)


def acknowledged(client: Bus, first: int, count: int) -> list[float]:
    """Seconds from sending an episode of 450 samples to its acknowledgement, `count` times."""
    return [acknowledged_once(client, number) for number in range(first, first + count)]


def acknowledged_once(client: Bus, number: int) -> float:
    """Seconds from sending the episode with this number to its acknowledgement."""
    episode = make_episode(number, EPISODE_SAMPLES, fill=False)
    start_s = time.perf_counter()
    ack = client.request(EPISODE, episode, EpisodeAck, ident=episode.robot, timeout_s=30.0)
    spent_s = time.perf_counter() - start_s
    assert ack.accepted, ack.reason
    return spent_s


@dataclass
class During:
    """Acknowledgements while replay told before and after that it was within a pass."""

    spent: list[float] = field(default_factory=list)
    states: list[ReplayState] = field(default_factory=list)
    """What it told before each of them."""
    others: int = 0
    """Episodes that were not sent within a pass, or not for certain."""


def acknowledged_in_passes(client: Bus, first: int, count: int) -> During:
    """Hand over episodes, whose turns go over the whole memory, until `count` came during one."""
    inbox = client.inbox()
    inbox.subscribe(REPLAY_STATE, "main")
    found, number = During(), first
    deadline_s = time.monotonic() + PATIENCE_S + count
    acknowledged_once(client, number)  # its turn is the first pass
    while len(found.spent) < count:
        before = next_state(inbox, deadline_s)
        if not within_a_pass(before):
            continue
        number += 1
        spent_s = acknowledged_once(client, number)
        if within_a_pass(next_state(inbox, deadline_s)):
            time.sleep(PAUSE_S)
            found.spent.append(spent_s)
            found.states.append(before)
        else:
            found.others += 1
    return found


def next_state(inbox: Inbox, deadline_s: float) -> ReplayState:
    """What replay tells next; nothing it told before."""
    inbox.take(REPLAY_STATE, ReplayState)
    while time.monotonic() < deadline_s:
        inbox.wait(0.5)
        for _, state in inbox.take(REPLAY_STATE, ReplayState):
            return state
    raise TimeoutError("replay tells nothing, or does not go over its memory")


def within_a_pass(state: ReplayState) -> bool:
    """Whether replay is describing or equalising the memory right now."""
    return state.activity in ("descriptors", "equalising") and 0.0 < state.progress < 1.0


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
                for part in parts(version, data, weights_hash(data)):
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


@contextmanager
def learner(client: Bus, config: Config) -> Iterator[None]:
    """Answers for the initial weights, so that replay can describe and predict."""
    data, stop = to_bytes(initialised(config.network, 1)), threading.Event()
    inbox = client.inbox()
    inbox.serve(WEIGHTS)

    def serve() -> None:
        while not stop.is_set():
            inbox.wait(0.2)
            for request in inbox.requests():
                with request:
                    for part in parts(1, data, weights_hash(data)):
                        request.reply(part)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def during_passes(mode: Mode) -> During:
    """Acknowledgements beside a replay that equalises its memory after every episode."""
    capacity, filters = (900, 4) if mode == "check" else (45_000, 64)
    config = Config.model_validate(
        {
            "run": {"name": "bench"},
            "bus": {"endpoint": free_endpoint(), "heartbeat_s": 0.01},
            "memory": {"capacity": capacity, "equalise_every": 1},
            "network": {"filters": filters},
            "numerics": {"replay": {"threads": 0, "precision": "auto"}},
        }
    )
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "run"
        first = fill(folder, config)
        settle_all(settings.claim(folder, config), folder)
        with system(config, folder, SERVED), bus(config) as client, learner(client, config):
            return acknowledged_in_passes(client, first, rounds_of(mode, 50, 200))


def without_passes(mode: Mode) -> list[Bar]:
    """Snapshots, weights, and acknowledgements while replay has nothing else to do."""
    capacity = {"check": 900, "short": 45_000, "full": 45_000}[mode]
    filters = 4 if mode == "check" else 64
    config = Config.model_validate(
        {
            "run": {"name": "bench"},
            "bus": {"endpoint": free_endpoint(), "shared_memory": True},
            "memory": {"capacity": capacity, "strategy": "normm", "equalise_every": 0},
            "network": {"filters": filters},
        }
    )
    actor = choose(config, ActorNumerics(engine="auto", precision="auto"), "actor")
    numerics = config.numerics.model_copy(update={"actor": actor})
    config = config.model_copy(update={"numerics": numerics})
    rounds, acks = rounds_of(mode, 5, 15), rounds_of(mode, 50, 200)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "run"
        first = fill(folder, config)
        with (
            system(config, folder, SERVED),
            bus(config, shared_memory=True) as on,
            bus(config) as off,
        ):
            rates: dict[bool, list[float]] = {True: [], False: []}
            for _ in range(rounds):
                rates[False].append(snapshot_rate(off))
                rates[True].append(snapshot_rate(on))
            spent = acknowledged(off, first, acks)
            delays = ready(off, config, rounds_of(mode, 20, 50))
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


def measure(mode: Mode) -> tuple[str, list[Bar]]:
    """A line on the passes, and all bars."""
    bars, during = without_passes(mode), during_passes(mode)
    passes = {(state.change, state.activity) for state in during.states}
    line = (
        f"P7e: {len(during.spent)} acknowledgements within {len(passes)} passes over "
        f"{during.states[-1].size} samples; {during.others} others do not count"
    )
    return line, [*bars, _delay("P7e", during.spent, 120, 120)]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and report."""
    line, bars = measure(mode_of(arguments, __doc__))
    what = {
        "P7a": "snapshot, shared memory off",
        "P7b": "snapshot, shared memory on",
        "P7c": "weights published until ready",
        "P7d": "episode of 450 until on disk",
        "P7e": "the same during a pass over the memory",
    }
    rows = [[what[bar.id], bar.value, bar.unit, bar.n] for bar in bars]
    report("Bulk transfer", [table(["what", "value", "unit", "n"], rows), line], bars)


if __name__ == "__main__":
    main()
