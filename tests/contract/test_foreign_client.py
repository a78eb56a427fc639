"""Clients that know nothing but zenoh, msgpack and docs/protocol.md take part in a run.

Nothing of our packages is imported for speaking: messages are plain dictionaries, as a program in
another language would build them. Only starting our own services uses our code.
"""

from __future__ import annotations

import hashlib
import queue
import struct
import time
from collections.abc import Iterator
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import zenoh
from cluster import Cluster, make_config
from foreign import Client, pack, wait_for

from services.security import router_file
from services.security.authority import Authority
from services.security.kinds import Credential

LIFE = "feedc0ffee00"
pytestmark = [pytest.mark.system, pytest.mark.timeout(150)]


GUARDED = pytest.mark.parametrize("cluster", ["open", "guarded"], indirect=True)
"""Without and with certificates."""


@pytest.fixture
def cluster(request: pytest.FixtureRequest, tmp_path: Path, run_name: str) -> Iterator[Cluster]:
    config = make_config(run_name)
    if getattr(request, "param", "open") == "guarded":
        guard(tmp_path / "secure")
        bus = config.bus.model_copy(update={"credentials": str(tmp_path / "secure")})
        config = config.model_copy(update={"bus": bus})
    with Cluster(config, tmp_path / "run") as cluster:
        cluster.start("router")
        assert cluster.bus
        yield cluster


def guard(folder: Path) -> None:
    """Credentials for our services and for the foreign ones."""
    authority, until = Authority.create(folder), datetime.now(UTC) + timedelta(days=1)
    authority.certify_router([], until)
    for kind, *robots in (
        *(("replay",), ("learner",), ("actor",), ("operator",), ("driver", "robotino1")),
        *(("driver", "cube"), ("actor", "cube"), ("pilot", "robotino1")),
    ):
        authority.add(Credential(kind, tuple(robots)), until)
    router_file.write(authority)


@pytest.fixture
def client(cluster: Cluster) -> Iterator[Client]:
    with ExitStack() as stack:
        yield connect(cluster, "pilot-robotino1", stack)


def connect(cluster: Cluster, name: str, stack: ExitStack) -> Client:
    """A foreign program; where the router is guarded, with the credential of this name."""
    bus = cluster.config.bus
    credentials = f"{bus.credentials}/{name}" if bus.credentials else ""
    client = Client(bus.endpoint, cluster.config.run.name, credentials)
    stack.enter_context(client.session)
    return client


@GUARDED
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
                by="network",
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
                by="network",
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


@GUARDED
def test_foreign_driver_is_driven_for_50_actions(cluster: Cluster) -> None:
    with ExitStack() as stack:
        is_driven(cluster, connect(cluster, "driver-cube", stack))
        (progress,) = connect(cluster, "actor-cube", stack).ask(
            "replay/main/progress/cube", pack("ProgressRequest", robot="cube")
        )
    assert progress["robot_fills"] >= 4
    assert progress["robot_life"] == LIFE


def is_driven(cluster: Cluster, client: Client) -> None:
    """A robot of nobody's making does what our actor says."""
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
        sample_by=bytes(count),
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
