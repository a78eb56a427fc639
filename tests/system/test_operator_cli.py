"""Status, stop and the commands to robots, against stand-ins for services and a real router."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from fakes import answering, fake_driver, fake_service, message

from benchmarks.waiting import wait_until
from services.cli import main as cli
from shared.bus import Bus
from shared.config import Config
from shared.keys import LEARNER_STATE, REPLAY_STATE, ROBOT_WORLD
from shared.messages import (
    Box,
    Halt,
    HaltKind,
    LearnerState,
    Message,
    ReplayState,
    StopService,
    WorldChange,
    WorldChanged,
)
from shared.settings import load

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]


@pytest.fixture
def config(router: str, run_name: str) -> Config:
    return load(overrides=[f"bus.endpoint={router}", f"run.name={run_name}"])


@pytest.fixture
def options(config: Config) -> list[str]:
    return ["--run", config.run.name, "--endpoint", config.bus.endpoint]


@pytest.fixture
def watching(config: Config) -> Iterator[Bus]:
    with Bus(config.bus, config.run.name) as bus:
        yield bus


def wait_for_peers(bus: Bus, count: int) -> None:
    wait_until(lambda: len(bus.peers()) == count, 10, f"{count} services to be visible")


def test_status_lists_services_and_what_they_tell(
    config: Config, options: list[str], watching: Bus, capsys: pytest.CaptureFixture[str]
) -> None:
    replay = message(ReplayState, episode=12, size=300, capacity=400, by_action=(100, 90, 110))
    learner = message(LearnerState, episode=11, weights_version=7)
    done = threading.Event()

    def beat(bus: Bus) -> None:
        while not done.wait(0.1):
            bus.publish(REPLAY_STATE, replay)
            bus.publish(LEARNER_STATE, learner)

    with (
        fake_service(config, "replay", "main", []) as bus,
        fake_service(config, "learner", "main", []),
    ):
        wait_for_peers(watching, 2)
        thread = threading.Thread(target=beat, args=(bus,))
        thread.start()
        try:
            assert cli.main(["status", *options, "--require", "replay"]) == 0
            table = capsys.readouterr().out
            assert cli.main(["status", *options, "--json", "--require", "actor"]) == 1
            output = capsys.readouterr()
        finally:
            done.set()
            thread.join()
    for part in ("replay", "learner", "main", "1234", "0:01:01", "300 of 400", "forward 100"):
        assert part in table
    assert output.err == "corridor: no answer from actor\n"
    told = json.loads(output.out)
    assert [(s["service"], s["answers"]) for s in told["services"]] == [
        ("learner", True),
        ("replay", True),
    ]
    assert told["replay"]["episode"] == 12
    assert told["learner"]["weights_version"] == 7
    assert told["robots"] == {}


def test_status_of_nobody(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["status", *options]) == 0
    assert "no service is alive" in capsys.readouterr().out


def test_status_shows_who_is_there_but_silent(
    config: Config, options: list[str], watching: Bus, capsys: pytest.CaptureFixture[str]
) -> None:
    with Bus(config.bus, config.run.name) as mute:
        mute.announce("actor", "main", "0" * 12, 1, config.fingerprint())
        wait_for_peers(watching, 1)
        assert cli.main(["status", *options, "--require", "actor"]) == 1
    assert "no answer" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["estop", "clear", "pause", "resume"])
def test_commands_reach_all_robots_and_print_what_they_acknowledge(
    command: str,
    config: Config,
    options: list[str],
    watching: Bus,
    capsys: pytest.CaptureFixture[str],
) -> None:
    kind: HaltKind = "estop" if command in ("estop", "clear") else "pause"
    begin = command in ("estop", "pause")
    # Both kinds are in force before a release, which ends one of them.
    state = {"estop": "estop", "clear": "paused", "pause": "paused", "resume": "estop"}[command]
    with ExitStack() as stack:
        robots = [stack.enter_context(fake_driver(config, robot)) for robot in ("r1", "r2")]
        wait_for_peers(watching, 2)
        if not begin:
            for robot in robots:
                robot.book.add([Halt(number=7, kind="estop"), Halt(number=8, kind="pause")])
        assert cli.main([command, *options]) == 0
        told = capsys.readouterr().out.splitlines()
        end = ", stands" if begin else ""
        assert sorted(told) == [f"{r.name} (life {r.life}): {state}{end}" for r in robots]
        for robot in robots:
            assert (kind in robot.book.kinds(robot.name)) == begin
        assert cli.main([command, *options, "--robot", "r2"]) == 0
        assert capsys.readouterr().out.startswith(f"r2 (life {robots[1].life}): {state}")
        assert len(robots[0].book.halts) == 1
        assert len(robots[1].book.halts) == (2 if begin else 1)


def test_a_halt_goes_on_until_every_life_stands(
    config: Config, options: list[str], watching: Bus, capsys: pytest.CaptureFixture[str]
) -> None:
    with fake_driver(config, "r1") as quick, fake_driver(config, "r1", refusals=3) as slow:
        wait_for_peers(watching, 2)
        assert cli.main(["estop", *options]) == 0
        assert set(capsys.readouterr().out.splitlines()) == {
            f"r1 (life {robot.life}): estop, stands" for robot in (quick, slow)
        }
        assert slow.asked == 4


def test_a_command_that_nobody_hears_fails_in_one_line(
    options: list[str],
    config: Config,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("shared.halts.orders.NOBODY_S", 0.5)
    for command in ("estop", "clear"):
        for robot in ([], ["--robot", "r9"]):
            assert cli.main([command, *options, *robot]) == 1
            error = capsys.readouterr().err
            assert error.startswith(f"corridor: no robot of run '{config.run.name}' answers at")
            assert error.count("\n") == 1


PLACED = Box(
    name="b1",
    x_m=1.0,
    y_m=-2.5,
    heading_deg=30.0,
    length_m=0.4,
    width_m=0.5,
    height_m=0.5,
    rgb=(1, 2, 3),
)


@pytest.mark.parametrize(
    ("command", "wish"),
    [
        (
            "world switch minus --start 1 --at-episode 20",
            WorldChange(kind="switch", world="minus", start=1, at_episode=20),
        ),
        (
            "obstacle place b1 --x 1 --y -2.5 --heading-deg 30 --length 0.4 --rgb 1 2 3",
            WorldChange(kind="place", box=PLACED),
        ),
        ("obstacle remove b1", WorldChange(kind="remove", name="b1")),
    ],
)
def test_changes_of_the_world_reach_robots_and_print_what_they_answer(
    command: str,
    wish: WorldChange,
    config: Config,
    options: list[str],
    watching: Bus,
    capsys: pytest.CaptureFixture[str],
) -> None:
    heard: list[Message] = []
    answers = {
        "r1": message(WorldChanged, accepted=True, world="plus", obstacles=("a", "b"), pending=2),
        "r2": message(WorldChanged, accepted=False, reason="no such thing", obstacles=()),
    }

    with ExitStack() as stack:
        for robot, told in answers.items():

            def answer(request: Message, told: WorldChanged = told) -> WorldChanged:
                heard.append(request)
                return told

            stack.enter_context(fake_service(config, "driver", robot, []))
            stack.enter_context(answering(config.bus, config.run.name, robot, answer, ROBOT_WORLD))
        wait_for_peers(watching, 2)
        assert cli.main([*command.split(), *options, "--robot", "r1"]) == 0
        assert capsys.readouterr().out == "r1: world plus, obstacles a, b, 2 changes waiting\n"
        assert cli.main([*command.split(), *options]) == 1
        assert capsys.readouterr().err == "r2: refused: no such thing\n"
    ids = [request.id for request in heard if isinstance(request, WorldChange)]
    assert ids[0] not in ("", ids[1])
    assert ids[1] == ids[2]
    assert heard == [wish.model_copy(update={"id": ident}) for ident in ids]


@pytest.mark.parametrize(
    ("command", "complaint"),
    [
        ("world switch Nowhere!", "corridor: switch: world: "),
        ("world switch minus --at-episode -1", "corridor: Invalid value for '--at-episode'"),
        ("obstacle place box --x nan --y 0", "corridor: place: box.x_m: "),
        ("obstacle place box --x 1 --y 0 --rgb 1 2 300", "corridor: place: box.rgb.2: "),
        ("obstacle place box --x 1", "corridor: Missing option '--y'"),
        ("obstacle remove box --robot A!", "corridor: --robot: expected a name"),
    ],
)
def test_changes_that_cannot_be_meant_are_refused_before_anything_is_sent(
    command: str, complaint: str, options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([*command.split(), *options]) == 2
    error = capsys.readouterr().err
    assert error.startswith(complaint)
    assert error.count("\n") == 1


def test_stop_reaches_chosen_services_and_tells_who_stays(
    config: Config,
    options: list[str],
    watching: Bus,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("services.monitor.operator.GONE_WITHIN_S", 0.5)
    commands: list[Message] = []
    with fake_service(config, "replay", "main", commands):
        wait_for_peers(watching, 1)
        assert cli.main(["stop", *options, "--service", "actor"]) == 1
        assert "no actor of run" in capsys.readouterr().err
        assert commands == []
        assert cli.main(["stop", *options]) == 1
        assert capsys.readouterr().out == "replay main: still there\n"
        assert commands == [StopService()]
