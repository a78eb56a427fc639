"""Clients that know nothing but zenoh, msgpack and docs/protocol.md take part in a run.

Nothing of our packages is imported for speaking: messages are plain dictionaries, as a program in
another language would build them. Only starting our own services uses our code.
"""

from __future__ import annotations

import hashlib
import json
import queue
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zenoh
from cluster import Cluster, make_config

LIFE = "feedc0ffee00"
DEADLINE_S = 60.0
pytestmark = [pytest.mark.system, pytest.mark.timeout(150)]


def pack(name: str, **fields: Any) -> bytes:
    return msgpack.packb({"v": 2, "t": name, **fields})


class Client:
    """A foreign program's whole Zenoh layer."""

    def __init__(self, endpoint: str, run: str) -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([endpoint]))
        config.insert_json5("scouting/multicast/enabled", "false")
        self.session, self.run = zenoh.open(config), run

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


@pytest.fixture
def cluster(tmp_path: Path, run_name: str) -> Iterator[Cluster]:
    with Cluster(make_config(run_name), tmp_path / "run") as cluster:
        cluster.start("router")
        assert cluster.bus
        yield cluster


@pytest.fixture
def client(cluster: Cluster) -> Iterator[Client]:
    client = Client(cluster.config.bus.endpoint, cluster.config.run.name)
    yield client
    client.session.close()


def wait_for(received: queue.Queue[dict[str, Any]], **fields: Any) -> dict[str, Any]:
    """The next message with these field values."""
    deadline_s = time.monotonic() + DEADLINE_S
    while True:
        message = received.get(timeout=max(deadline_s - time.monotonic(), 0.01))
        if all(message[name] == value for name, value in fields.items()):
            return message


def test_foreign_actor_drives_our_robot_for_50_actions(cluster: Cluster, client: Client) -> None:
    observations = client.subscribe("robot/robotino1/observation")
    cluster.start("driver")
    bumps = 0
    places = []
    for sequence in range(51):
        seen = wait_for(observations, sequence=sequence)
        assert seen["t"] == "Observation"
        assert len(seen["image"]) == 50 * 75
        bumps += seen["bump"]
        places.append((seen["x_m"], seen["y_m"]))
        told = (None, "") if sequence == 0 else ((sequence - 1) % 3, LIFE)
        assert (seen["action"], seen["actor_life"]) == told
        client.session.put(
            f"{client.run}/actor/robotino1/action",
            pack(
                "Action",
                robot="robotino1",
                actor_life=LIFE,
                robot_life=seen["life"],
                sequence=sequence,
                attempt=seen["attempt"],
                action=sequence % 3,
                greedy=False,
                values=[0.0, 0.0, 0.0],
                weights_version=0,
            ),
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
    assert len(set(places)) > 40
    assert bumps
    halt = {"number": time.time_ns(), "kind": "estop", "robot": ""}
    told = client.ask_all("halt", pack("Halts", halts=[halt]))["driver-robotino1"]
    assert (told["t"], told["state"], told["stands"]) == ("Standing", "estop", True)
    assert told["halts"] == [halt]
    deadline = {"life": told["life"], "until_s": told["clock_s"] + 2.0}
    release = {"numbers": [halt["number"]], "robot": ""}
    late = {**deadline, "until_s": told["clock_s"] - 1.0}
    for deadlines, stands in (([], True), ([late], True), ([deadline], False)):
        answer = client.ask_all("release", pack("Release", **release, deadlines=deadlines))
        assert answer["driver-robotino1"]["stands"] == stands
    # A copy of the halt that comes late holds nobody again.
    told = client.ask_all("halt", pack("Halts", halts=[halt]))["driver-robotino1"]
    assert (told["stands"], told["halts"]) == (False, [])


def test_foreign_client_changes_the_world_of_our_robot(cluster: Cluster, client: Client) -> None:
    observations = client.subscribe("robot/robotino1/observation")
    cluster.start("driver")
    first = wait_for(observations, sequence=0, attempt=0)
    key = "robot/robotino1/world"

    def change(**fields: Any) -> dict[str, Any]:
        (answer,) = client.ask(key, pack("WorldChange", **fields))
        assert answer["t"] == "WorldChanged"
        return answer

    box = {"name": "b1", "x_m": 3.8, "y_m": 1.0, "length_m": 0.6, "width_m": 0.6}
    box |= {"height_m": 0.6, "rgb": [250, 0, 0]}
    placed = change(kind="place", box=box, id="00000000000b")
    assert (placed["accepted"], placed["world"], placed["obstacles"]) == (True, "plus", ["b1"])
    seen = wait_for(observations, sequence=0, attempt=1)
    assert (seen["interruption"], seen["world"]) == ("", "plus")
    assert seen["image"] != first["image"]
    assert change(kind="place", box=box, id="00000000000b") == placed  # sent again: done once
    # What cannot be is refused with a reason; what is no change at all, with an error.
    for fields, reason in (
        ({"kind": "place", "box": box}, "there is already an obstacle 'b1'"),
        ({"kind": "place", "box": {**box, "name": "b2", "y_m": 0.0}}, "would overlap the robot"),
        ({"kind": "switch", "world": "maze"}, "no world named 'maze'"),
        ({"kind": "switch", "world": "minus", "start": 99}, "expected a start from 0 to"),
    ):
        refused = change(**fields)
        assert (refused["accepted"], refused["obstacles"]) == (False, ["b1"])
        assert reason in refused["reason"]
    for fields in ({"kind": "switch"}, {"kind": "place", "box": {"name": "b3"}}, {"kind": "burn"}):
        (error,) = client.refusals(key, pack("WorldChange", **fields))
        assert (error["t"], error["final"]) == ("Refusal", True)
        assert error["reason"].startswith("bad message: ")
    # Wildcards are refused: answers to them could not be told apart.
    (error,) = client.refusals("robot/*/world", pack("WorldChange", kind="list"))
    assert (error["final"], "concrete key" in error["reason"]) == (True, True)
    # At an episode: instead of the first action that tells it.
    change(kind="switch", world="i16c", at_episode=1, id="00000000000c")
    assert change(kind="switch", world="minus", at_episode=2)["pending"] == 2
    assert [c["world"] for c in change(kind="list")["waiting"]] == ["i16c", "minus"]
    left = change(kind="withdraw", id="00000000000c")
    assert (left["accepted"], [c["world"] for c in left["waiting"]]) == (True, ["minus"])
    assert change(kind="withdraw", id="00000000000c")["accepted"] is False
    attempt = wait_for(observations, sequence=0, world="plus")["attempt"]
    for sequence, episode in ((0, 0), (1, 1), (2, 2)):
        client.session.put(
            f"{client.run}/actor/robotino1/action",
            pack(
                "Action",
                robot="robotino1",
                actor_life=LIFE,
                robot_life=first["life"],
                sequence=sequence,
                attempt=attempt if sequence == 0 else 0,
                action=1,
                greedy=False,
                values=[0.0, 0.0, 0.0],
                weights_version=0,
                episode=episode,
            ),
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        wait_for(observations, sequence=min(sequence + 1, 2), attempt=int(episode == 2))
    seen = wait_for(observations, sequence=2, attempt=1)
    assert (seen["world"], seen["interruption"]) == ("minus", "world")
    states = client.subscribe("robot/robotino1/state")
    state = wait_for(states, world="minus")
    assert (state["pending_changes"], state["refused_changes"]) == (0, 5)


def test_foreign_driver_is_driven_for_50_actions(cluster: Cluster, client: Client) -> None:
    actions = client.subscribe("actor/cube/action")
    cluster.start("replay", "learner", "actor")
    x_m, answer = 0.0, None
    for sequence in range(50):
        led = {"action": answer["action"], "actor_life": answer["actor_life"]} if answer else {}
        observation = pack(
            "Observation",
            robot="cube",
            life=LIFE,
            sequence=sequence,
            image=bytes([sequence]) * 3750,
            x_m=x_m,
            y_m=0.0,
            heading_rad=0.0,
            bump=sequence % 10 == 9,
            world="garden",
            period_s=0.25,
            stamp_s=0.25 * sequence,
            **led,
        )
        answer = None
        while answer is None:  # lockstep: sent again until answered
            client.session.put(f"{client.run}/robot/cube/observation", observation)
            try:
                answer = actions.get(timeout=0.5)
            except queue.Empty:
                continue
            if answer["sequence"] != sequence:
                answer = None
        assert answer["t"] == "Action"
        assert answer["robot_life"] == LIFE
        assert answer["action"] in (0, 1, 2)
        x_m += 0.15
    progress = client.ask("replay/main/progress/cube", pack("ProgressRequest", robot="cube"))[0]
    assert progress["robot_fills"] >= 4
    assert progress["robot_life"] == LIFE


def episode(number: int, *, count: int = 3, fill: bool = True, version: int = 1) -> bytes:
    return pack(
        "Episode",
        robot="cube",
        life=LIFE,
        number=number,
        fill=fill,
        ended="bump",
        bump=True,
        weights_version=version,
        fitness=count,
        actions=count,
        dropped_samples=0,
        dropped_episodes=0,
        worlds=["garden"],
        images=bytes(3750 * count),
        sample_actions=bytes(i % 3 for i in range(count)),
        sample_rewards=struct.pack(f"<{count}f", *[0.5] * (count - 1), -1.0),
        sample_steps=struct.pack(f"<{count}I", *range(count)),
        sample_episodes=struct.pack(f"<{count}I", *[0] * count),
        sample_versions=struct.pack(f"<{count}I", *[1] * count),
        sample_worlds=bytes(count),
        positions=struct.pack(f"<{3 * count}f", *[0.0] * 3 * count),
        robot_life=LIFE,
        last_sequence=count * (number + 1) - 1,
    )


def test_foreign_episode_is_acknowledged_once_however_often_sent(
    cluster: Cluster, client: Client
) -> None:
    cluster.start("replay")
    first = client.ask("replay/main/episode/cube", episode(0))[0]
    assert (first["t"], first["accepted"], first["duplicate"]) == ("EpisodeAck", True, False)
    again = client.ask("replay/main/episode/cube", episode(0))[0]
    assert (again["accepted"], again["duplicate"], again["commit"]) == (True, True, first["commit"])
    second = client.ask("replay/main/episode/cube", episode(1))[0]
    assert second["commit"] == first["commit"] + 1
    early = client.ask("replay/main/episode/cube", episode(2, fill=False))[0]
    assert early["accepted"] is False
    assert "being filled" in early["reason"]
    other = client.ask("replay/main/episode/cube", episode(1, count=2))[0]
    assert (other["accepted"], other["duplicate"]) == (False, False)
    assert "stored with other content" in other["reason"]
    assert client.refusals("replay/main/episode/cube", episode(3, version=99))
    cluster.kill("replay")
    cluster.start("replay")
    after = client.ask("replay/main/episode/cube", episode(1))[0]
    assert (after["duplicate"], after["commit"]) == (True, second["commit"])


def test_foreign_learner_mirrors_the_memory_and_is_heard(cluster: Cluster, client: Client) -> None:
    cluster.start("replay")
    for number in range(134):
        assert client.ask("replay/main/episode/cube", episode(number))[0]["accepted"]
    assert not client.ask("replay/main/episode/cube", episode(134))[0]["accepted"]  # it was told
    done = client.ask("replay/main/episode/cube", episode(134, fill=False))[0]
    assert done["episode"] == 1
    weights = b"\x02\x00\x00\x00\x00\x00\x00\x00{}"
    digest = hashlib.sha256(weights).hexdigest()[:16]
    cluster.wait(lambda: (s := cluster.replay()) is not None and s.commit == 135, 20, "commits")
    *parts, end = client.ask("replay/main/snapshot", pack("SnapshotRequest"))
    assert end["t"] == "FeedEnd"
    assert end["rows"] == sum(len(part["ids"]) // 8 for part in parts)
    assert end["messages"] == len(parts)
    for lineage in (end["lineage"], "f" * 16):
        request = pack("ChangesRequest", since=end["change"], upto=end["change"], lineage=lineage)
        (followed,) = client.ask("replay/main/changes", request)
        assert followed["gone"] == (lineage != end["lineage"])
    state = pack(
        "LearnerState",
        id="main",
        life=LIFE,
        episode=0,
        weights_version=1,
        weights_hash=digest,
        activity="waiting",
        loss=None,
        train_steps=0,
        fits=0,
        target_age=0,
        resyncs=0,
        undecodable=0,
    )
    client.session.put(f"{client.run}/learner/main/state", state)
    heard = cluster.learner
    cluster.wait(lambda: heard() is not None, 20, "the foreign learner is heard")
    batch = client.ask("replay/main/mini_batch", pack("MiniBatchRequest", size=8, key=1))[0]
    assert len(batch["ids"]) == 64
    assert len(batch["images"]) == 8 * 3750
