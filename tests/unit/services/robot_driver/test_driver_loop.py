"""The driver's own thread with a real robot's limits: what no actor and no operator can break."""

from __future__ import annotations

import logging
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fake_link import FakeLink, config_of

from benchmarks.waiting import wait_until
from services.robot_driver.driver import Driver
from services.robot_driver.host import Host
from services.robot_driver.motion_control import SLICE_S
from services.robot_driver.real.hardware import HardwareRobot
from services.robot_driver.recovery import WatchedRobot, back_off
from services.robot_driver.robot import STANDSTILL, Felt, Pose, Velocity
from services.robot_driver.safety import Safety
from services.robot_driver.service import DriverLoop
from shared import statefile
from shared.config import Config
from shared.halts.book import new_halt
from shared.halts.keeper import clock_s
from shared.keys import OBSERVATION, Stream
from shared.messages import Action, Deadline, HaltKind, Message, Motion, Observation, Release
from shared.service import StopFlag

LIFE, ACTOR = "a" * 12, "b" * 12
CONFIG = config_of(
    period_s=0.4,
    deadman_s=0.6,
    speed_m_s=0.2,
    turn_rad_s=0.6,
    max_speed_m_s=0.25,
    max_turn_rad_s=0.75,
    recovery_speed_m_s=0.1,
)


class Request:
    """A command of an operator, and what was answered."""

    def __init__(self, message: Message) -> None:
        self.message = message
        self.replies: list[Any] = []
        self.refusals: list[str] = []
        self.reply, self.refuse = self.replies.append, self.refusals.append

    def __enter__(self) -> Request:
        return self

    def __exit__(self, *_: object) -> None:
        pass


class FakeBus:
    """Inbox and bus in one, whose messages the test puts in and reads."""

    def __init__(self) -> None:
        self.observations: list[Observation] = []
        self.actions: list[Action] = []
        self.commands: list[Request] = []
        self.refused = self.busy = Counter[str]()
        self.router = "1"
        self.asked = 0
        """How often halts in force were asked for."""
        self._woken = threading.Event()

    def inbox(self) -> FakeBus:
        return self

    def subscribe(self, *_: object, **__: object) -> None:
        pass

    serve = subscribe

    def ask_all(self, *_: object, **__: object) -> None:
        self.asked += 1

    def answers(self, *_: object) -> list[Any]:
        return []

    peers = answers

    def wake(self) -> None:
        self._woken.set()

    def wait(self, timeout_s: float) -> bool:
        return self._woken.wait(timeout_s)

    def requests(self) -> Iterator[Request]:
        taken, self.commands = self.commands, []
        return iter(taken)

    def take(self, *_: object) -> list[tuple[str, Action]]:
        taken, self.actions = self.actions, []
        return [("main", action) for action in taken]

    def publish(self, stream: Stream, message: Any, _: str) -> None:
        if stream is OBSERVATION:
            self.observations.append(message)


class Stand:
    """A driver loop in a thread, in front of a robot that does as told."""

    def __init__(self, folder: Path, config: Config) -> None:
        self.link, self.bus, self.folder = FakeLink(), FakeBus(), folder
        self.robot = HardwareRobot(config.robot, self.link)
        self.driver = Driver(config, self.robot, LIFE)
        self.stop = StopFlag()
        self.numbers: list[int] = []
        self.kinds: list[HaltKind] = []
        me: Any = SimpleNamespace(
            stop=self.stop,
            log=logging.getLogger("test"),
            bus=self.bus,
            config=config,
            name="driver",
            ident=config.robot.id,
            life=LIFE,
        )
        self.loop = DriverLoop(me, self.driver, folder)
        self.thread = threading.Thread(target=self.loop.run)
        self.thread.start()

    def answer(self, action: int | None, motion: Motion = "") -> None:
        """Answer the newest observation."""
        self.next_look()
        seen = self.bus.observations[-1]
        self.bus.actions.append(
            Action(
                robot=seen.robot,
                actor_life=ACTOR,
                robot_life=LIFE,
                sequence=seen.sequence,
                attempt=seen.attempt,
                action=action,
                motion=motion,
                by="network",
                values=(0.0, 0.0, 0.0),
                weights_version=1,
            )
        )

    def next_look(self) -> None:
        self.look(len(self.bus.observations))

    def look(self, number: int) -> Observation:
        """The observation with this number, counted from 0."""
        self.until(lambda: len(self.bus.observations) > number, "an observation")
        return self.bus.observations[number]

    def ask(self, *orders: str) -> list[Request]:
        """Halt or release as an operator does, all at once."""
        requests = [Request(self._message(order)) for order in orders]
        self.bus.commands = requests
        self.until(lambda: all(r.replies or r.refusals for r in requests), "answers")
        return requests

    def _message(self, order: str) -> Message:
        kind: HaltKind = "estop" if order in ("estop", "clear") else "pause"
        if order in ("estop", "pause"):
            self.numbers.append(len(self.numbers))
            self.kinds.append(kind)
            return new_halt(kind, "", self.numbers[-1])
        numbers = tuple(n for n in self.numbers if self.kinds[n] == kind)
        deadline = Deadline(life=LIFE, until_s=clock_s() + 1.0)
        return Release(numbers=numbers or (999,), deadlines=(deadline,))

    def until(self, condition: Callable[[], Any], what: str) -> None:
        wait_until(condition, 20, what)

    @property
    def moved(self) -> bool:
        return any(velocity.moving for velocity in self.link.told)


@contextmanager
def standing(folder: Path, config: Config = CONFIG) -> Iterator[Stand]:
    stand = Stand(folder, config)
    try:
        yield stand
    finally:
        stand.stop.set("test")
        stand.thread.join(20)
        stand.robot.close()
        assert not stand.thread.is_alive()


@pytest.mark.parametrize("motion", ["", "turn-left"])
def test_a_touched_robot_that_stands_does_not_move(motion: Motion, tmp_path: Path) -> None:
    with standing(tmp_path) as stand:
        stand.next_look()
        stand.link.pressed = True
        stand.until(lambda: stand.robot.feel().contact, "the touch is felt")
        if motion:  # nobody knows from which side it is touched
            stand.answer(None, motion)
        for _ in range(3):
            stand.next_look()
        assert not stand.moved
        assert (stand.driver.bumps, stand.driver.recoveries) == (0, 0)
        stand.answer(0)  # an action into the wall is a bump
        stand.until(lambda: stand.driver.bumps == 1, "a bump")
        stand.until(lambda: stand.moved, "recovery")


def test_contact_while_it_coasts_is_a_bump(tmp_path: Path) -> None:
    hardware = CONFIG.robot.hardware.model_copy(update={"rest_s": 5.0})
    robot = CONFIG.robot.model_copy(update={"hardware": hardware})
    with standing(tmp_path, CONFIG.model_copy(update={"robot": robot})) as stand:
        stand.answer(0)
        stand.until(lambda: stand.moved, "it drives")
        stand.until(lambda: stand.link.told[-1] == STANDSTILL, "it stops, nobody answers")
        stand.link.pressed = True
        stand.until(lambda: stand.driver.bumps == 1, "a bump")


def test_the_end_of_the_service_stops_a_recovery(tmp_path: Path) -> None:
    with standing(tmp_path) as stand:
        stand.answer(0)
        stand.until(lambda: stand.moved, "it drives")
        stand.link.pressed = True
        stand.until(lambda: stand.driver.state == "recovering", "recovery")
        stand.link.pressed = False
        stand.until(lambda: stand.link.told[-1].forward_m_s < 0, "it backs off")
        stand.stop.set("SIGTERM")
        stand.thread.join(20)
        assert not stand.thread.is_alive()
        assert stand.driver.recoveries == 0
        stand.until(lambda: stand.link.told[-1] == STANDSTILL, "it stands")


def test_an_emergency_stop_holds_where_it_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with standing(tmp_path) as stand:
        with monkeypatch.context() as patch:
            patch.setattr(statefile, "write_atomically", full)
            (request,) = stand.ask("estop")
        (told,) = request.replies
        assert told.stands
        assert "[Errno 28]" in told.problem
        assert stand.driver.safety.estop
        (request,) = stand.ask("estop")
        assert (request.replies[0].state, request.replies[0].problem) == ("estop", "")
        with monkeypatch.context() as patch:
            patch.setattr(statefile, "write_atomically", full)
            (request,) = stand.ask("clear")
        assert "[Errno 28]" in request.replies[0].problem
        assert request.replies[0].halts
        assert stand.driver.safety.estop
        (request,) = stand.ask("clear")
        assert request.replies[0].state != "estop"
        assert request.replies[0].halts == ()


def test_a_release_that_comes_late_or_is_meant_for_another_life_releases_nothing(
    tmp_path: Path,
) -> None:
    with standing(tmp_path) as stand:
        stand.ask("estop")
        for life, until_s in ((LIFE, clock_s() - 0.1), (ACTOR, clock_s() + 1.0)):
            late = Request(Release(numbers=(0,), deadlines=(Deadline(life=life, until_s=until_s),)))
            stand.bus.commands = [late]
            stand.until(lambda asked=late: asked.replies, "an answer")
            assert late.replies[0].state == "estop"
        assert stand.driver.safety.estop


def test_a_driver_that_starts_again_stands_by_what_is_on_disk(tmp_path: Path) -> None:
    for order, state in (("estop", "estop"), ("pause", "paused")):
        folder = tmp_path / order
        with standing(folder) as stand:
            stand.ask(order)
        with standing(folder) as stand:
            (request,) = stand.ask("clear" if order == "pause" else "resume")
            assert request.replies[0].state == state
            assert not stand.moved


def test_a_robot_that_may_not_move_asks_for_no_actions(tmp_path: Path) -> None:
    with standing(tmp_path) as stand:
        stand.next_look()
        stand.ask("pause")
        asked = len(stand.bus.observations)
        for _ in range(3):
            stand.ask("pause")
        assert len(stand.bus.observations) == asked
        stand.ask("resume")
        assert stand.look(asked).interruption == "pause"


def test_a_stop_within_an_action_is_told_however_soon_it_is_released(tmp_path: Path) -> None:
    with standing(tmp_path) as stand:
        stand.answer(0)
        stand.until(lambda: stand.moved, "it drives")
        looked = len(stand.bus.observations)
        stand.ask("estop", "clear")
        seen = stand.look(looked)
        assert (seen.sequence, seen.interruption) == (0, "estop")


@pytest.mark.parametrize("look_s", [0.0, 0.06, 0.12])
def test_a_slow_driver_drives_no_farther_back(look_s: float) -> None:
    """The way of a recovery is limited by the robot's clock, not by the number of looks."""

    class Clock(Host):
        now, moved_s = 0.0, 0.0
        sense = feel = state = restore = close = lambda *_: None
        drive = lambda *_: None  # noqa: E731

        def now_s(self) -> float:
            return self.now

        def run(self, duration_s: float, *, stop_on_contact: bool) -> bool:
            self.now += duration_s
            return False

        def look(self) -> None:
            self.now += look_s

    clock: Any = Clock()
    robot = WatchedRobot(clock, Safety(CONFIG.robot), clock, SLICE_S)
    robot.run(1.0, stop_on_contact=False)
    assert 1.0 - 1e-9 <= clock.now <= 1.0 + SLICE_S + look_s


def test_odometry_that_jumps_makes_no_long_way_forward() -> None:
    """After a retreat that a wall ended the robot creeps forward half of what it had won."""

    class Jumping:
        way_m, speed_m_s, feels, runs = 0.0, 0.0, 0, 0

        def feel(self) -> Felt:
            self.feels += 1
            return Felt(Pose(0.0 if self.feels < 3 else 2.0, 0.0, 0.0), False)

        def drive(self, velocity: Velocity) -> None:
            self.speed_m_s = velocity.forward_m_s

        def run(self, duration_s: float, *, stop_on_contact: bool) -> bool:
            self.runs += 1
            self.way_m += max(self.speed_m_s, 0.0) * duration_s
            return self.runs == 1

    robot: Any = Jumping()
    back_off(robot, CONFIG.robot, 0.0)
    assert 0.0 < robot.way_m <= CONFIG.robot.recovery_distance_m / 2.0 + 1e-9


def test_a_closed_terminal_is_a_clean_end() -> None:
    code = (
        "import os, signal\n"
        "from shared.service import StopFlag, answer_signals\n"
        "stop = StopFlag()\n"
        "answer_signals(stop)\n"
        "os.kill(os.getpid(), signal.SIGHUP)\n"
        "print(stop.wait(10.0), stop.reason)\n"
    )
    for ignored, said in ((False, "True SIGHUP"), (True, "False")):
        text = code if not ignored else code.replace("10.0", "0.1")
        before = "SIG_IGN" if ignored else "SIG_DFL"  # as under nohup; as in a terminal
        text = f"import signal; signal.signal(signal.SIGHUP, signal.{before})\n{text}"
        done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True)
        assert done.stdout.startswith(said), done.stderr


def test_halts_are_asked_for_again_when_the_router_is_another_one(tmp_path: Path) -> None:
    with standing(tmp_path) as stand:
        stand.answer(0)
        stand.until(lambda: stand.driver.sequence == 1, "an action")
        assert stand.bus.asked == 1
        stand.bus.router = "2"
        stand.answer(0)
        stand.until(lambda: stand.driver.sequence == 2, "another action")
        assert stand.bus.asked == 2


def test_nothing_is_driven_while_there_is_no_router(tmp_path: Path) -> None:
    with standing(tmp_path) as stand:
        stand.bus.router = ""
        for _ in range(3):
            stand.answer(0)
        stand.until(lambda: stand.driver.late_actions >= 3, "periods without an action")
        assert not stand.moved
