"""Bad messages on every key anyone can write: counted, refused or ignored, and the run goes on."""

from __future__ import annotations

import json
from collections.abc import Iterator

import msgpack
import pytest
import zenoh
from builders import make_episode, make_observation
from cluster import ALL, Cluster, make_config
from fakes import message

from benchmarks.waiting import wait_until
from shared.codec import decode, encode
from shared.keys import STREAMS, Stream
from shared.messages import (
    Action,
    ActorState,
    Episode,
    LearnerState,
    Message,
    MiniBatchRequest,
    Observation,
    Refusal,
    Release,
    ReplayState,
    RobotState,
    WorldChange,
)

pytestmark = [pytest.mark.system, pytest.mark.timeout(150)]
REQUESTS = [s for s in STREAMS if s.delivery == "request"]
TAKEN = [s for s in STREAMS if s.name in ("observation", "action", "replay_state", "learner_state")]
"""Published streams that a service takes in; the others only the monitor reads."""
UNCOUNTED = ("ping", "stop")
"""Requests whose refusals no heartbeat counts."""


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A whole system at work; all tests of this module attack the same one."""
    with Cluster(make_config("attacked"), tmp_path_factory.mktemp("attacked") / "run") as cluster:
        cluster.start(*ALL)
        cluster.wait_episodes(1, 90)
        yield cluster
        before = cluster.learner()
        assert before is not None
        cluster.wait_episodes(before.episode + 3, 60)  # it still learns after all of it
        cluster.stop_all()  # and every process ends cleanly: none had crashed


@pytest.fixture(scope="module")
def attacker(cluster: Cluster) -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([cluster.config.bus.endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        yield session


def ask_all(attacker: zenoh.Session, key: str, payload: bytes | None) -> list[zenoh.Reply]:
    """What every life that serves a key answers."""
    return list(
        attacker.get(
            key,
            zenoh.handlers.FifoChannel(64),
            payload=payload,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=10.0,
        )
    )


def ident(stream: Stream) -> str:
    return "replay-main" if stream.name in UNCOUNTED else "robotino1"


def example(stream: Stream) -> Message:
    """A valid message of a stream."""
    if stream.request is Episode:
        return make_episode(3)
    if stream.request is Observation:
        return make_observation(0, robot="robotino1")
    if stream.request is MiniBatchRequest:
        return MiniBatchRequest(size=1, key=1)
    if stream.request is WorldChange:
        return WorldChange(kind="remove", name="box")
    if stream.request is Release:
        return Release(numbers=(1,), deadlines=())
    return message(stream.request)


def bad_payloads(stream: Stream) -> dict[str, bytes]:
    good = msgpack.unpackb(encode(example(stream)))
    field = next(name for name in good if name not in ("v", "t")) if len(good) > 2 else "extra"
    deep: object = 0
    for _ in range(400):
        deep = [deep]
    return {
        "not msgpack": b"\xc1\xff\x00",
        "nothing": b"",
        "a list": msgpack.packb([1, 2, 3]),
        "other version": msgpack.packb({**good, "v": 999}),
        "no version": msgpack.packb({k: v for k, v in good.items() if k != "v"}),
        "other type": msgpack.packb({**good, "t": "Nonsense"}),
        "unknown field": msgpack.packb({**good, "intruder": 1}),
        "wrong type": msgpack.packb({**good, field: {"a": [1]}}),
        "deep nesting": msgpack.packb({**good, field: deep}),
        "huge announced length": b"\xdf\xff\xff\xff\xff",
        "oversized": bytes(stream.max_bytes + 1),
    }


def refused(cluster: Cluster, stream: Stream) -> int:
    """What the services that take this stream in count as refused, from their heartbeats."""
    states = {
        "observation": ("actor/robotino1/state", ActorState),
        "action": ("robot/robotino1/state", RobotState),
        "halt": ("robot/robotino1/state", RobotState),
        "release": ("robot/robotino1/state", RobotState),
        "robot_world": ("robot/robotino1/state", RobotState),
        "replay_state": ("learner/main/state", LearnerState),
        "weights": ("learner/main/state", LearnerState),
        "learner_state": ("actor/robotino1/state", ActorState),
    }
    suffix, cls = states.get(stream.name, ("replay/main/state", ReplayState))
    inbox = cluster.bus.inbox()
    known = next(s for s in STREAMS if s.request is cls)
    inbox.subscribe(known)
    taken = wait_until(lambda: inbox.take(known, cls), 20, f"heartbeat {suffix}")
    return int(taken[0][1].undecodable)  # type: ignore[attr-defined]


@pytest.mark.parametrize("stream", REQUESTS, ids=[s.name for s in REQUESTS])
def test_bad_requests_are_answered_with_an_error(
    cluster: Cluster, attacker: zenoh.Session, stream: Stream
) -> None:
    key = stream.key(cluster.config.run.name, ident(stream))
    before = 0 if stream.name in UNCOUNTED else refused(cluster, stream)
    lives = 4 if stream.name in ("halt", "release") else 1  # everybody serves them
    payloads = bad_payloads(stream)
    for name, payload in payloads.items():
        replies = ask_all(attacker, key, payload)
        assert len(replies) == lives, name
        for reply in replies:
            assert reply.ok is None, name
            assert reply.err is not None, name
            assert decode(reply.err.payload.to_bytes(), Refusal).final, name
    replies = ask_all(attacker, key, None)  # no payload at all
    assert [reply.ok for reply in replies] == [None] * lives
    if stream.name not in UNCOUNTED:
        expected = before + len(payloads) + 1
        wait_until(lambda: refused(cluster, stream) >= expected, 20, "all are counted")


@pytest.mark.parametrize("stream", TAKEN, ids=[s.name for s in TAKEN])
def test_bad_publications_are_counted_and_ignored(
    cluster: Cluster, attacker: zenoh.Session, stream: Stream
) -> None:
    key = stream.key(cluster.config.run.name, ident(stream))
    before = refused(cluster, stream)
    for name, payload in bad_payloads(stream).items():
        attack_until_counted(cluster, attacker, stream, key, payload, name)
    assert refused(cluster, stream) >= before + len(bad_payloads(stream))


def attack_until_counted(
    cluster: Cluster, attacker: zenoh.Session, stream: Stream, key: str, payload: bytes, what: str
) -> None:
    """Send until refused: the true sender's next message may replace a bad one before it is read.

    That is what `latest` means; a replaced message harms nobody and is counted nowhere.
    """
    count = refused(cluster, stream)

    def counted() -> bool:
        attacker.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)
        return refused(cluster, stream) > count

    wait_until(counted, 60, f"{what} is counted")


@pytest.mark.parametrize("stream", TAKEN, ids=[s.name for s in TAKEN])
def test_put_to_a_wildcard_key_reaches_nobody(
    cluster: Cluster, attacker: zenoh.Session, stream: Stream
) -> None:
    key = f"{cluster.config.run.name}/**"
    attack_until_counted(cluster, attacker, stream, key, encode(example(stream)), "wildcard")


def test_message_under_another_robots_key_is_refused(
    cluster: Cluster, attacker: zenoh.Session
) -> None:
    stream = next(s for s in STREAMS if s.name == "action")
    forged = encode(message(Action, robot="somebody-else"))
    key = stream.key(cluster.config.run.name, "robotino1")
    attack_until_counted(cluster, attacker, stream, key, forged, "forged action")


def test_replayed_messages_change_nothing(cluster: Cluster, attacker: zenoh.Session) -> None:
    """Old observations, actions and announcements come again, as recorded from the bus."""
    run = cluster.config.run.name
    recorded: dict[str, bytes] = {}

    def record(sample: zenoh.Sample) -> None:
        recorded.setdefault(str(sample.key_expr), sample.payload.to_bytes())

    subscriber = attacker.declare_subscriber(f"{run}/**", record)
    wait_until(lambda: len(recorded) >= 6, 30, "one message of every published stream")
    subscriber.undeclare()
    before = cluster.learner()
    assert before is not None
    cluster.wait_episodes(before.episode + 2, 60)
    for _ in range(20):
        for key, payload in recorded.items():
            attacker.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)
    now = cluster.learner()
    assert now is not None
    cluster.wait_episodes(now.episode + 3, 60)


def test_valid_lies_about_turns_and_weights_do_not_stop_learning(
    cluster: Cluster, attacker: zenoh.Session
) -> None:
    run = cluster.config.run.name
    state = cluster.replay()
    assert state is not None
    for lie in (
        {"turn": state.turn + 1000, "turn_change": 0},
        {"turn": 0, "lineage": "0" * 16},
        {"lineage": "f" * 16},
        {"known_version": 2**31 - 1},
    ):
        attacker.put(f"{run}/replay/main/state", encode(state.model_copy(update=lie)))
    attacker.put(f"{run}/robot/ghost/observation", encode(make_observation(0, robot="ghost")))
    learner = cluster.learner()
    assert learner is not None
    cluster.wait_episodes(learner.episode + 3, 60)
