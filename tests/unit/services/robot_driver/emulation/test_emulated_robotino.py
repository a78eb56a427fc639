"""The emulated Robotino answers as the real one does, and is wrong on demand only."""

from __future__ import annotations

import json
from collections.abc import Iterator

import httpx
import pytest
import simplejpeg
from robots import robotino_server

from benchmarks.waiting import wait_until
from services.robot_driver.emulation.robotino import Faults, RobotinoServer
from services.robot_driver.emulation.ros2_faults import Ros2Faults
from services.robot_driver.real.picture import decoded
from services.robot_driver.real.robotino_replies import odometry
from shared.errors import BadMessage, ConfigError

Client = httpx.Client


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    with (
        robotino_server() as (_, address),
        Client(base_url=f"http://{address}", timeout=30.0, trust_env=False) as one,
    ):
        yield one


@pytest.fixture(autouse=True)
def sound(client: Client) -> None:
    spoil(client, **Faults().model_dump())


def spoil(client: Client, **faults: object) -> None:
    assert client.post("/emulator/faults", content=json.dumps(faults)).status_code == 200


def test_the_first_picture_after_idle_time_is_an_error_and_the_next_is_not(client: Client) -> None:
    statuses = [client.get("/cam0").status_code for _ in range(3)]
    assert statuses[1:] == [200, 200]
    picture = client.get("/cam0", params={"sid": "x", "stamp": 1})
    assert picture.headers["content-type"] == "image/jpeg"
    assert simplejpeg.decode_jpeg_header(picture.content)[:2] == (600, 800)
    assert decoded(picture.content).std() > 5
    assert picture.content != client.get("/cam0").content


def test_it_reads_like_a_robotino(client: Client) -> None:
    assert client.get("/data/bumper").json() == {"value": False}
    first, second = (odometry(client.get("/data/odometry").content)[1] for _ in range(2))
    assert second >= first
    assert '"batteryLow": false' in client.get("/data/powermanagement").text
    assert len(client.get("/data/distancesensorarray").json()) == 9
    for path in ("/data/scan0", "/data/festoolcharger"):
        assert (client.get(path).status_code, client.get(path).content) == (200, b"")
    assert client.get("/data/gyroscope").status_code == 404
    assert client.put("/data/relay", content=b"{}").status_code == 404


def test_whole_numbers_are_integers(client: Client) -> None:
    assert client.get("/data/odometry").text.startswith("[0, 0, 0, 0, 0, 0, ")


@pytest.mark.parametrize(
    "body",
    [
        b"", b"[]", b"[0,0]", b"[0,0,0,0]", b"{}", b"[0,0,true]", b'[0,0,"1"]', b"[NaN,0,0]",
        b"[2.1,0,0]", b"[0,-2.1,0]", b"[0,0,3.1]", b"[1e999,0,0]", b"[" * 3000,
        b"[" + b"9" * 1000 + b",0,0]",
    ],
)  # fmt: skip
def test_commands_out_of_range_are_refused_and_not_cut(body: bytes, client: Client) -> None:
    before = len(client.get("/emulator/truth").json()["commands"])
    assert client.put("/data/omnidrive", content=body).status_code == 400
    assert len(client.get("/emulator/truth").json()["commands"]) == before


def test_too_much_of_a_command_is_refused(client: Client) -> None:
    assert client.put("/data/omnidrive", content=b" " * 5000).status_code == 413


@pytest.mark.parametrize(
    ("ignored", "method", "moves"),
    [(False, "PUT", True), (False, "POST", True), (True, "PUT", True), (True, "POST", False)],
)
def test_old_images_ignore_post(ignored: bool, method: str, moves: bool, client: Client) -> None:
    spoil(client, post_ignored=ignored)
    before = len(client.get("/emulator/truth").json()["commands"])
    assert client.request(method, "/data/omnidrive", content=b"[0, 0, 0.1]").status_code == 200
    told = client.get("/emulator/truth").json()["commands"]
    assert (len(told) > before) == moves


def test_a_single_command_moves_it_a_little_and_its_watchdog_stops_it(client: Client) -> None:
    stops = client.get("/emulator/truth").json()["watchdog_stops"]
    client.put("/data/omnidrive", content=b"[0.2, 0, 0]")
    wait_until(
        lambda: client.get("/emulator/truth").json()["watchdog_stops"] > stops, 20, "it stops"
    )
    wait_until(
        lambda: client.get("/emulator/truth").json()["still_since_s"] is not None, 20, "it stands"
    )


def test_frozen_readings_repeat_and_stalled_motors_do_not(client: Client) -> None:
    spoil(client, odometry="frozen", camera="frozen")
    for path in ("/data/odometry", "/cam0"):
        client.get(path)
        assert client.get(path).content == client.get(path).content
    spoil(client, odometry="stalled", camera="")
    pose, first = odometry(client.get("/data/odometry").content)
    client.put("/data/omnidrive", content=b"[0.2, 0, 0]")
    wait_until(
        lambda: odometry(client.get("/data/odometry").content)[1] > first + 40, 20, "time passes"
    )
    assert odometry(client.get("/data/odometry").content)[0] == pose


def test_pictures_can_break_off_or_fail(client: Client) -> None:
    client.get("/cam0")
    spoil(client, camera="truncated")
    with pytest.raises(BadMessage, match="damaged or cut off"):
        decoded(client.get("/cam0").content)
    spoil(client, camera="500")
    assert client.get("/cam0").status_code == 500
    spoil(client, camera="empty")
    assert client.get("/cam0").content == b""


@pytest.mark.parametrize("network", ["cut", "reset"])
def test_a_broken_network_leaves_the_ways_of_tests_open(network: str, client: Client) -> None:
    spoil(client, network=network)
    with pytest.raises(httpx.HTTPError):
        client.get("/data/bumper")
    assert client.get("/emulator/faults").json()["network"] == network


def test_silence_is_silence(client: Client) -> None:
    spoil(client, network="silent")
    with pytest.raises(httpx.ReadTimeout):
        client.get("/data/bumper", timeout=0.3)


@pytest.mark.parametrize(
    "body", [b"", b"[]", b'{"camera": "blue"}', b'{"nothing": 1}', b'{"stall_s": -1}', b"[" * 3000]
)
def test_unknown_faults_are_refused_and_change_nothing(body: bytes, client: Client) -> None:
    before = client.get("/emulator/faults").json()
    assert client.post("/emulator/faults", content=body).status_code == 400
    assert client.get("/emulator/faults").json() == before


def test_faults_as_texts() -> None:
    texts = ["camera=frozen", "battery_low=true", "stall_s=0.5"]
    faults = Faults().with_texts(texts)
    assert (faults.camera, faults.battery_low, faults.stall_s) == ("frozen", True, 0.5)
    assert faults.with_texts(["camera=", "battery_low=", "stall_s="]) == Faults()
    assert Ros2Faults(payload_of="camera").with_texts(["payload_of="]) == Ros2Faults()
    for bad in (["camera"], ["camera=blue"], ["x=1"]):
        with pytest.raises(ValueError, match=r"NAME=VALUE|camera|x"):
            Faults().with_texts(bad)


@pytest.mark.parametrize("listen", ["8080", "host:port", "127.0.0.1:99999", ":1"])
def test_where_it_cannot_listen(listen: str) -> None:
    with pytest.raises(ConfigError, match=r"^--listen: expected host:port"):
        RobotinoServer(listen, None)  # type: ignore[arg-type]
