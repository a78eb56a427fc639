"""Messages of valid form that lie: counted, told of, and the run goes on without a restart.

A stranger on an open network says each lie a hundred times and stops. The robot's own episodes must
then be learnt from again. Nothing of our packages is imported for lying.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import msgpack
import pytest
import zenoh
from cluster import ALL, SERVICES, Cluster, make_config
from foreign import Client, pack

from benchmarks.waiting import wait_until
from shared.halts.orders import order

pytestmark = [pytest.mark.system, pytest.mark.timeout(150)]
LIFE, OTHER = "badbadbadbad", "0badbadbad00"
TIMES, BURST_S = 100, 1.0
GOES_ON_S = 30.0
BIG, LAST = 2**31, 2**32 - 1
FLOOD = 12
"""More lines than this in a log are not one a kind."""
Message = dict[str, Any]


class Liar(Client):
    """Knows what is said on the bus, and says it again with changes."""

    def __init__(self, cluster: Cluster) -> None:
        super().__init__(cluster.config.bus.endpoint, cluster.config.run.name)
        self.heard: dict[str, Message] = {}
        self._said: set[bytes] = set()
        self._news = threading.Condition()
        self.session.declare_subscriber(f"{self.run}/**", self._hear)

    def _hear(self, sample: zenoh.Sample) -> None:
        payload = sample.payload.to_bytes()
        if payload not in self._said:
            key = str(sample.key_expr).removeprefix(f"{self.run}/")
            with self._news:
                self.heard[key] = msgpack.unpackb(payload)
                self._news.notify_all()

    def put(self, key: str, payload: bytes) -> None:
        self._said.add(payload)
        super().put(key, payload)

    def true(self, key: str) -> Message:
        """The newest message of a key that is none of our lies."""
        return wait_until(lambda: self.heard.get(key), 20, f"something on {key}")

    def publish(self, key: str, lie: Callable[[int], Message], of: str | None = None) -> None:
        """Say it a hundred times in between what others say: a true message (`of`) with changes."""
        for number in range(TIMES):
            with self._news:
                self._news.wait(BURST_S / TIMES)
            changed = {**self.true(of or key), **lie(number)}
            self.put(key.format(number), msgpack.packb(changed))

    def ask_often(self, key: str, lie: Callable[[int], bytes]) -> list[Message]:
        """Ask a hundred times, without waiting for one answer before the next question."""
        replies = [
            self.session.get(
                f"{self.run}/{key.format(number)}",
                zenoh.handlers.FifoChannel(64),
                payload=lie(number),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=10.0,
            )
            for number in range(TIMES)
        ]
        return [
            msgpack.unpackb((reply.ok or reply.err).payload.to_bytes())
            for channel in replies
            for reply in channel
        ]


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A whole system at work; all tests of this module lie to the same one."""
    config = make_config(f"lied-to-{os.getpid()}")
    with Cluster(config, tmp_path_factory.mktemp("lies") / "run") as cluster:
        cluster.start(*ALL)
        cluster.wait_episodes(2, 90)
        before = {(peer.service, peer.life) for peer in cluster.bus.peers()}
        yield cluster
        assert {(peer.service, peer.life) for peer in cluster.bus.peers()} == before
        cluster.stop_all()


@pytest.fixture
def liar(cluster: Cluster) -> Iterator[Liar]:
    liar = Liar(cluster)
    with liar.session:
        yield liar


def learnt(cluster: Cluster) -> int:
    """Episodes that were learnt from: from disk, since what is said may be a lie."""
    return len((cluster.folder / "training.csv").read_text().splitlines()) - 1


def stored(cluster: Cluster) -> int:
    """Episodes on disk, those of liars included."""
    path = cluster.folder / "episodes.csv"
    return len(path.read_text().splitlines()) - 1


@pytest.fixture(autouse=True)
def goes_on(cluster: Cluster) -> Iterator[None]:
    """The robot's episodes are learnt from after each lie, and no log is flooded."""
    before = {name: said(cluster, name) for name in SERVICES}
    yield
    new = {name: said(cluster, name)[len(before[name]) :] for name in SERVICES}
    assert max(len(lines) for lines in new.values()) <= FLOOD, new
    actions = own_episodes(cluster)
    cluster.wait(lambda: own_episodes(cluster) >= actions + 2, GOES_ON_S, "own episodes stored")
    goal = stored(cluster)
    cluster.wait(lambda: learnt(cluster) >= goal, GOES_ON_S, f"{goal} episodes learnt")


def own_episodes(cluster: Cluster) -> int:
    """Stored episodes of the robot itself: liars say that theirs have one sample."""
    lines = (cluster.folder / "episodes.csv").read_text().splitlines()
    robot, actions = (lines[0].split(",").index(name) for name in ("robot", "actions"))
    rows = [line.split(",") for line in lines[1:]]
    return sum(row[robot] == "robotino1" and row[actions] != "77" for row in rows)


def said(cluster: Cluster, name: str) -> list[str]:
    return (cluster.folder / f"{name}.out").read_text().splitlines()


OBSERVATION, ACTION = "robot/robotino1/observation", "actor/robotino1/action"
ROBOT, ACTOR = "robot/robotino1/state", "actor/robotino1/state"
REPLAY, LEARNER = "replay/main/state", "learner/main/state"


def counted(liar: Liar, key: str, field: str, lie: Callable[[], object]) -> None:
    """Lie until a heartbeat counts it, if there is a field for it."""
    before = liar.true(key)[field] if field else -1

    def grows() -> bool:
        lie()
        return not field or liar.true(key)[field] > before

    wait_until(grows, 20, f"{field} of {key} counts it")


FAR = {"x_m": 1e6, "y_m": -1e6, "laps_left": BIG - 1, "laps_right": BIG - 1}
OBSERVATIONS: dict[str, tuple[Callable[[Message, int], Message], str]] = {
    "another life": (lambda true, n: {"life": LIFE, "sequence": n}, "rival_observations"),
    "a life that continues ours": (
        lambda true, n: {"life": LIFE, "earlier": [true["life"]]},
        "rival_observations",
    ),
    "far ahead": (lambda true, n: {**FAR, "sequence": LAST - TIMES + 1 + n}, "stale_observations"),
    "a late attempt": (lambda true, n: {**FAR, "attempt": 2**63 - 1}, ""),
}


@pytest.mark.parametrize("name", OBSERVATIONS)
def test_observations_of_our_robot(liar: Liar, name: str) -> None:
    lie, field = OBSERVATIONS[name]
    true = liar.true(OBSERVATION)
    counted(liar, ACTOR, field, lambda: liar.publish(OBSERVATION, lambda n: lie(true, n)))


def test_observations_of_robots_that_are_not_there(liar: Liar) -> None:
    key = "robot/ghost{}/observation"

    def lie(number: int) -> Message:
        return {"robot": f"ghost{number}", "life": LIFE, "earlier": []}

    counted(liar, ACTOR, "busy", lambda: liar.publish(key, lie, OBSERVATION))
    for _ in range(TIMES):
        liar.put("robot/ghost/observation", msgpack.packb({**liar.true(OBSERVATION), **lie(0)}))


@pytest.mark.parametrize("motion", ["", "turn-left"])
def test_actions_of_another_actor(liar: Liar, motion: str) -> None:
    """What the robot executes for somebody else is no sample of our actor."""
    seen, answers = liar.subscribe(OBSERVATION), liar.subscribe(ACTION)
    before, sent, earlier = liar.true(ACTOR)["foreign_actions"], 0, samples(liar)
    while sent < TIMES:
        true = answers.get(timeout=20)
        if true["actor_life"] != LIFE:  # the next one is not known yet: the lie comes first
            lie = {"actor_life": LIFE, "sequence": true["sequence"] + 1, "attempt": 0}
            lie |= {"action": None if motion else 1, "motion": motion}
            liar.put(ACTION, msgpack.packb({**true, **lie}))
            sent += 1
    if motion:
        return
    wait_until(lambda: liar.true(ACTOR)["foreign_actions"] > before, 20, "they are counted")
    told = [seen.get_nowait() for _ in range(seen.qsize())]
    led = {one["sequence"] - 1 for one in told if one["actor_life"] == LIFE}
    executed = {one["image"] for one in told if one["sequence"] in led}
    executed -= {one["image"] for one in told if one["sequence"] not in led}  # it may look the same
    assert executed
    assert not (samples(liar) - earlier) & executed


def samples(liar: Liar) -> set[bytes]:
    """Images of the whole memory."""
    *parts, _ = liar.ask("replay/main/snapshot", pack("SnapshotRequest"))
    kept = b"".join(part["images"] for part in parts)
    return {kept[start : start + 3750] for start in range(0, len(kept), 3750)}


STATES: dict[str, tuple[str, Message, str]] = {
    "learner ahead": (LEARNER, {"weights_version": BIG, "episode": BIG}, ""),
    "another learner": (
        LEARNER,
        {"life": LIFE, "weights_version": BIG, "episode": BIG},
        "undecodable",
    ),
    "replay ahead": (
        REPLAY,
        {"turn": 2**62, "change": 2**62, "turn_change": 2**62, "episode": 2**62, "capacity": 0},
        "",
    ),
    "another replay": (
        REPLAY,
        {"life": LIFE, "turn": 0, "lineage": "f" * 16, "known_version": LAST, "capacity": 2**62},
        "",
    ),
}


@pytest.mark.parametrize("name", STATES)
def test_states_of_learner_and_replay(liar: Liar, name: str) -> None:
    key, lie, field = STATES[name]
    counted(liar, ACTOR, field, lambda: liar.publish(key, lambda _: lie))


def weights_that_lie(liar: Liar, name: str) -> list[bytes]:
    """The answer of a false learner: true weights, spoilt."""
    parts = liar.ask("learner/main/weights", pack("WeightsRequest"))
    data, version = b"".join(part["data"] for part in parts), parts[0]["version"] + 1
    head = 8 + int.from_bytes(data[:8], "little")
    if name == "not finite":
        data = data[:head] + struct.pack("<f", float("nan")) * ((len(data) - head) // 4)
    elif name == "wrong shapes":
        names = {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}
        header = json.dumps({"conv1.weight": names}).encode()
        data = len(header).to_bytes(8, "little") + header + bytes(4)
    elif name == "never made":
        version = LAST
    digest = "0" * 16 if name == "wrong hash" else hashlib.sha256(data).hexdigest()[:16]
    cut = {"version": version, "hash": digest, "part": 0, "parts": 1, "data": data[: 4 * 2**20]}
    return [pack("Weights", **cut)]


@pytest.mark.parametrize("name", ["not finite", "wrong shapes", "wrong hash", "never made"])
def test_weights_of_false_learners(liar: Liar, cluster: Cluster, name: str) -> None:
    """The router chooses whom it asks: the true learner, or one of four liars."""
    answers = weights_that_lie(liar, name)

    def answer(query: zenoh.Query) -> None:
        with query:
            for payload in answers:
                query.reply(query.key_expr, payload)

    key = f"{liar.run}/learner/main/weights"
    with ExitStack() as stack:
        for _ in range(4):
            session = stack.enter_context(Liar(cluster).session)
            session.declare_queryable(key, answer, complete=True)
        liar.publish(LEARNER, lambda _: {"weights_version": BIG})  # so that somebody asks


def episode(liar: Liar, cluster: Cluster, **fields: Any) -> bytes:
    """A valid episode of one sample; liars tell of 77 actions."""
    place = liar.true(OBSERVATION)
    version = liar.true(LEARNER)["weights_version"]
    plain: Message = {
        "robot": "robotino1",
        "life": LIFE,
        "number": 0,
        "fill": False,
        "ended": "bump",
        "bump": True,
        "weights_version": version,
        "fitness": 1,
        "actions": 77,
        "dropped_samples": 0,
        "dropped_episodes": 0,
        "worlds": ["plus"],
        "images": bytes(3750),
        "sample_actions": bytes(1),
        "sample_rewards": struct.pack("<f", -1.0),
        "sample_steps": bytes(4),
        "sample_episodes": bytes(4),
        "sample_versions": bytes(4),
        "sample_worlds": bytes(1),
        "sample_by": bytes(1),
        "positions": bytes(12),
        "robot_life": place["life"],
        "last_sequence": max(place["sequence"] - 100, 0),
    }
    return pack("Episode", **{**plain, **fields})


EPISODES: dict[str, Callable[[Message, int], Message]] = {
    "overlapping": lambda true, n: {"number": n},
    "far ahead": lambda true, n: {"number": 1000 + n, "last_sequence": LAST - 100 + n},
    "of a version nobody made": lambda true, n: {"weights_version": BIG, "number": n},
    "for filling": lambda true, n: {"fill": True, "number": n},
    "chosen by a newer version": lambda true, n: {"sample_versions": b"\xff" * 4, "number": n},
    "an identity that is stored": lambda true, n: {"life": true["life"], "number": 0},
    "identities to come": lambda true, n: {
        "life": true["life"],
        "robot_life": LIFE,
        "number": n,
        "last_sequence": n,
    },
}


@pytest.mark.parametrize("name", EPISODES)
def test_episodes_of_our_robot(liar: Liar, cluster: Cluster, name: str) -> None:
    true, lie = liar.true(ACTOR), EPISODES[name]
    field = "" if name in ("far ahead", "of a version nobody made") else "refused"
    key, kinds = "replay/main/episode/robotino1", set()

    def ask() -> None:
        for answer in liar.ask_often(key, lambda n: episode(liar, cluster, **lie(true, n))):
            kinds.add(answer["reason"].partition(":")[0])

    counted(liar, REPLAY, field, ask)
    assert kinds, name


def test_questions_about_what_is_not_there(liar: Liar) -> None:
    last = 2**63 - 1
    for key, question in {
        "replay/main/progress/ghost{}": lambda n: pack("ProgressRequest", robot=f"ghost{n}"),
        "replay/main/turns": lambda n: pack("TurnsRequest", since=last - n, limit=1000),
        "replay/main/changes": lambda n: pack(
            "ChangesRequest", since=last - n, upto=last, lineage="f" * 16
        ),
        "replay/main/mini_batch": lambda n: pack("MiniBatchRequest", size=4096, key=last - n),
    }.items():
        answers = liar.ask_often(key, question)
        assert len(answers) == TIMES, key
        assert {answer["t"] for answer in answers} & {"RobotProgress", "Turns", "FeedEnd", "Change"}


def ordered(cluster: Cluster, *names: str) -> list[str]:
    """An operator's orders, obeyed."""
    lines = list[str]()
    for name in names:
        cluster.wait(lambda name=name: order(cluster.bus, name, "", lines.append), 30, name)
    return lines


@pytest.mark.parametrize("kind", ["estop", "pause"])
def test_halts_by_the_dozen_hold_until_an_operator_releases_them(
    liar: Liar, cluster: Cluster, kind: str
) -> None:
    def halts(number: int) -> bytes:
        numbers = [2**63 - 1 - (64 * number + i) % 640 for i in range(64)]
        return pack("Halts", halts=[{"number": n, "kind": kind, "robot": ""} for n in numbers])

    liar.ask_often("halt", halts)
    wait_until(lambda: liar.true(ROBOT)["state"] == {"pause": "paused"}.get(kind, kind), 20, kind)
    ordered(cluster, "clear" if kind == "estop" else "resume")


def test_a_release_for_other_lives_releases_nobody(liar: Liar, cluster: Cluster) -> None:
    ordered(cluster, "estop")
    (halt,) = liar.ask_all("halt", pack("Halts"))["driver-robotino1"]["halts"]
    standing = liar.ask_all("halt", pack("Halts"))["driver-robotino1"]

    def release(number: int) -> bytes:
        late = {"life": standing["life"], "until_s": standing["clock_s"] - 1.0}
        early = {"life": standing["life"], "until_s": standing["clock_s"] + 1e6}
        deadlines = ([late], [early], [{"life": LIFE, "until_s": standing["clock_s"] + 2.0}], [])
        return pack("Release", numbers=[halt["number"]], robot="", deadlines=deadlines[number % 4])

    liar.ask_often("release", release)
    assert liar.ask_all("halt", pack("Halts"))["driver-robotino1"]["stands"]
    ordered(cluster, "clear")


def test_who_claims_that_a_halt_was_released_releases_nobody(liar: Liar, cluster: Cluster) -> None:
    ordered(cluster, "estop")
    (halt,) = liar.ask_all("halt", pack("Halts"))["driver-robotino1"]["halts"]
    truth = liar.ask_all("halt", pack("Halts"))["driver-robotino1"]
    lie = {**truth, "halts": [], "state": "waiting", "stands": False}
    lie["released"] = [{"number": halt["number"], "robot": ""}]
    asked = threading.Semaphore(0)

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, msgpack.packb(lie))
        asked.release()

    beside = liar.session.declare_queryable(f"{liar.run}/halt", answer)
    for _ in range(6):  # all services repeat the halt, and hear the lie
        assert asked.acquire(timeout=20)
    beside.undeclare()
    for who, standing in liar.ask_all("halt", pack("Halts")).items():
        assert standing["halts"] == [halt], who
        assert standing["released"] == [] or halt["number"] not in {
            entry["number"] for entry in standing["released"]
        }, who
    ordered(cluster, "clear")


def test_floods_of_changes_of_the_world(liar: Liar, cluster: Cluster) -> None:
    box = {"name": "b", "x_m": 1e6, "y_m": 0.0, "length_m": 0.1, "width_m": 0.1, "height_m": 0.1}
    lies: list[Message] = [
        {"kind": "switch", "world": "minus", "at_episode": 2**63 - 1},
        {"kind": "place", "box": {**box, "rgb": [0, 0, 0]}},
        {"kind": "remove", "name": "nothing"},
        {"kind": "switch", "world": "plus", "start": 1},
        {"kind": "withdraw", "id": LIFE},
    ]
    key = "robot/robotino1/world"
    flood = functools.partial(
        liar.ask_often, key, lambda n: pack("WorldChange", **lies[n % len(lies)])
    )
    counted(liar, ROBOT, "refused_changes", flood)


def test_tokens_of_our_roles_that_strangers_hold(liar: Liar, cluster: Cluster) -> None:
    liveliness, run = liar.session.liveliness(), liar.run
    tokens = []
    for number in range(TIMES):
        life = f"{number:012x}"
        service, ident = (("driver", "robotino1"), ("actor", "main"), ("replay", "main"))[
            number % 3
        ]
        for key in (
            f"alive/{service}/{ident}/{life}/2/{'0' * 16}",
            f"claim/{service}/{ident}/{life}",
        ):
            tokens.append(liveliness.declare_token(f"{run}/{key}"))

    def rivals() -> dict[str, int]:
        asked = {
            key: liar.ask_all(f"service/{key}/ping", pack("Ping"))
            for key in ("driver-robotino1", "actor-main", "replay-main")
        }
        return {key: answers[key]["rivals"] for key, answers in asked.items()}

    cluster.wait(lambda: min(rivals().values()) >= TIMES // 3, 20, "they are counted")
    for token in tokens:
        token.undeclare()
