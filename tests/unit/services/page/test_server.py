"""Updates at the pace of the browser, checked commands, and figures; without a browser or a bus."""

from __future__ import annotations

import asyncio
import json
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from builders import make_observation
from fakes import message
from starlette.testclient import TestClient, WebSocketTestSession
from starlette.websockets import WebSocket, WebSocketDisconnect

from services.monitor.heartbeats import Seen, Snapshot
from services.page import server as module
from services.page.address import Address
from services.page.browse import Browser
from services.page.commands import Command, Desk
from services.page.folder import Folder
from services.page.server import Link, Server
from services.page.track import Track
from services.page.watch import Watch
from shared.errors import CorridorError
from shared.messages import LearnerState, ReplayState, RobotState, Takeover, Told

TOKEN = "the-token"  # noqa: S105
HEADERS = {"host": "127.0.0.1:8000"}


class Taken(Desk):
    """Notes commands in place of carrying them out."""

    def __init__(self, watch: Watch) -> None:
        super().__init__(watch)
        self.commands: list[Command] = []

    def take(self, command: Command) -> threading.Thread:
        self.commands.append(command)
        return threading.current_thread()


@pytest.fixture
def watch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Watch:
    monkeypatch.setattr(module, "PERIOD_S", 0.01)
    monkeypatch.setattr(module, "ALIVE_S", 0.03)
    return Watch(lambda: None, Folder(tmp_path))


@pytest.fixture
def desk(watch: Watch) -> Taken:
    return Taken(watch)


@pytest.fixture
def client(watch: Watch, desk: Taken) -> TestClient:
    server = Server(watch, desk, Browser(None), Address("127.0.0.1", 8000, TOKEN))
    return TestClient(server.app, headers=HEADERS)


def update(socket: WebSocketTestSession) -> dict[str, Any]:
    return cast(dict[str, Any], json.loads(socket.receive_text()))


def test_a_browser_gets_what_is_new_to_it_once_it_has_painted_the_last(
    client: TestClient, watch: Watch
) -> None:
    watch.sections = {"a": "1", "b": "[2]"}
    with client.websocket_connect("/updates") as socket:
        assert update(socket) == {"number": 1, "sections": {"a": 1, "b": [2]}}
        assert watch.browsers == 1
        for value in range(50):  # while it paints
            watch.sections = {**watch.sections, "a": str(value)}
        socket.send_text('{"seen": 7}')  # there is no such update
        socket.send_text('{"seen": 1}')
        assert update(socket) == {"number": 2, "sections": {"a": 49}}
        socket.send_text('{"seen": 2}')
        assert update(socket) == {"number": 3, "sections": {}}  # a sign of life
    with client.websocket_connect("/updates") as socket:
        assert update(socket)["sections"] == {"a": 49, "b": [2]}


def test_nothing_is_sent_before_the_last_update_was_painted(
    watch: Watch, desk: Taken, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("PERIOD_S", "ALIVE_S"):
        monkeypatch.setattr(module, name, 1e-9)
    sent: list[str] = []

    class Socket:
        async def send_text(self, text: str) -> None:
            sent.append(text)

    async def look() -> None:
        link = Link(watch, desk, TOKEN, cast(WebSocket, Socket()))
        sending = asyncio.create_task(link.send())
        for number in (1, 2, 3):
            for value in range(200):
                watch.sections = {"a": f"{number}{value}"}
                await asyncio.sleep(0)
            assert len(sent) == number
            link.take(f'{{"seen": {number}}}')
        sending.cancel()

    asyncio.run(look())


def test_a_browser_that_paints_nothing_is_let_go(
    client: TestClient, watch: Watch, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "PAINTED_S", 0.05)
    with client.websocket_connect("/updates") as socket:
        update(socket)
        assert socket.receive()["type"] == "websocket.close"
    assert watch.browsers == 0


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ({"order": "estop"}, "no valid token"),
        ({"order": "estop", "token": "another"}, "no valid token"),
        ({"order": "explode", "token": TOKEN}, "order: "),
        ({"order": "estop", "token": TOKEN, "robot": "a/**"}, "robot: "),
        ({"token": TOKEN}, "expected one of"),
        ({"order": "estop", "note": "x", "token": TOKEN}, "expected one of"),
        ({"note": "x" * 201, "token": TOKEN}, "note: "),
        ({"note": "x", "token": TOKEN, "more": 1}, "more: "),
        ({"change": {"kind": "place"}, "token": TOKEN}, "place: expected box"),
        ({"note": "x" * 5000, "token": TOKEN}, "expected at most 4096 bytes"),
        (["estop"], "Input should be an object"),
    ],
)
def test_what_is_wrong_is_refused_and_told_to_its_sender(
    given: object, complaint: str, client: TestClient, desk: Taken
) -> None:
    with client.websocket_connect("/updates") as socket:
        update(socket)
        socket.send_text(json.dumps(given))
        assert complaint in json.loads(socket.receive_text())["refused"]
    assert desk.commands == []


def test_commands_with_the_token_are_taken(client: TestClient, desk: Taken) -> None:
    box = {"name": "box1", "x_m": 1, "y_m": 2.5, "length_m": 0.4, "width_m": 0.4, "height_m": 0.5}
    place = {"kind": "place", "box": {**box, "rgb": [1, 2, 3]}}
    with client.websocket_connect("/updates") as socket:
        update(socket)
        for given in ({"order": "estop"}, {"change": place, "robot": "r1"}, {"note": "it circles"}):
            socket.send_text(json.dumps({"token": TOKEN, **given}))
        socket.send_text('{"seen": 1}')
        update(socket)
    assert [command.what for command in desk.commands] == ["emergency stop", "place box1", "note"]


def test_what_a_person_who_drives_wants_is_said_to_the_actor(
    client: TestClient, watch: Watch, desk: Taken
) -> None:
    said: list[Takeover] = []
    bus: Any = SimpleNamespace(publish=lambda _, wish, __: said.append(wish))
    drive = {"token": TOKEN, "robot": "r1"}
    with client.websocket_connect("/updates") as socket:
        update(socket)
        socket.send_json({**drive, "wish": {"action": 0}})  # no router: it is said to nobody
        socket.send_json({**drive, "wish": {"action": 3}})
        assert "wish.action" in socket.receive_json()["refused"]
        watch.bus = bus
        for wish in ({"action": 2}, {}, {"give_back": True}):
            socket.send_json({**drive, "wish": wish})
        socket.send_json({"robot": "r1", "wish": {"action": 1}})
        assert "token" in socket.receive_json()["refused"]
        socket.send_json({"token": TOKEN, "wish": {"action": 1}})
        assert "wish with a robot" in socket.receive_json()["refused"]
    assert [(w.robot, w.number, w.action, w.give_back) for w in said] == [
        ("r1", 1, 2, False),
        ("r1", 2, None, False),
        ("r1", 3, None, True),
    ]
    assert len({w.life for w in said}) == 1
    assert desk.commands == []


def test_too_many_browsers_are_turned_away(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MOST_BROWSERS", 0)
    with pytest.raises(WebSocketDisconnect) as ended, client.websocket_connect("/updates"):
        pass
    assert ended.value.code == 1013


def test_orders_without_a_router_are_told_as_not_sent(watch: Watch, tmp_path: Path) -> None:
    desk = Desk(watch)
    watch.snapshot = Snapshot(replay=Seen(message(ReplayState, episode=9), 0.0))
    for command in (Command(order="estop"), Command(note="it circles")):
        desk.take(command).join(10.0)
    stop, note = desk.told()
    assert (stop["what"], stop["robot"]) == ("emergency stop", "all robots")
    assert stop["lines"] == ["NOT sent: no router answers"]
    assert note["lines"] == ["kept at episode 9"]


def test_too_much_at_once_is_told(watch: Watch, monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk(watch)
    monkeypatch.setattr("services.page.commands.AT_ONCE", {True: 0, False: 0})
    with pytest.raises(CorridorError, match="NOT sent"):
        desk.take(Command(order="estop"))
    assert desk.told() == []


def test_every_number_is_a_figure(client: TestClient, watch: Watch) -> None:
    replay = message(ReplayState, by_action=(5, 6, 7), retention=(Told(name="t", value=3),))
    robots = {"r1": Seen(message(RobotState, robot="r1", bumps=4), 0.5)}
    watch.snapshot = Snapshot(robots, {}, Seen(replay, 0.0), Seen(message(LearnerState), 0.0))
    watch.tracks["r1"] = track = Track()
    track.observe(make_observation(1), 0.0)
    track.delays_ms.append(12.0)
    text = client.get("/metrics").text
    for line in (
        'corridor_robot_bumps{robot="r1"} 4.0',
        'corridor_heartbeat_age_seconds{service="robot r1"} 0.5',
        'corridor_replay_by_action{action="2"} 7.0',
        'corridor_replay_retention{name="t"} 3.0',
        'corridor_action_latency_seconds{quantile="0.95",robot="r1"} 0.012',
        "corridor_learner_train_steps 0.0",
    ):
        assert line in text
    assert "corridor_learner_loss" not in text  # nobody has told it yet


def test_the_files_of_the_page_are_there_and_nothing_else(client: TestClient) -> None:
    assert "<title>Corridor" in client.get("/").text
    for name in ("main.js", "draw.js", "memory.js", "style.css"):
        answer = client.get(f"/{name}")
        assert answer.status_code == 200
        assert "http://" not in answer.text.replace("http://www.w3.org/2000/svg", "")
    assert client.get("/../server.py").status_code == 404
