"""P15: how soon robots stand while other drivers hang, and how soon an operator's stop is heard.

A driver of an emulated Robotino drives it, beside seven drivers of simulated robots, of which two
are frozen just before a halt is sent to all. What counts is the time from sending it until the
last of the others says that its robot stands, and until zero velocity has reached the robot. The
command `corridor estop` is started as an operator would start it, on a machine that is idle and
beside two processes that only spin; beside it, the time that Python takes to do nothing. The space
key is pressed in the terminal of a `corridor up` that trains.

    python -m benchmarks.stop_reaction [--short | --check]
"""

from __future__ import annotations

import queue
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from statistics import median, quantiles

from benchmarks.choose_action import spinning
from benchmarks.frame import Bar, Mode, mode_of, report, rounds_of, table
from benchmarks.robot_reaction import configuration
from benchmarks.robot_rig import PATIENCE_S, Rig
from benchmarks.terminals import Terminal
from benchmarks.waiting import wait_until
from shared.bus import Bus, Inbox, Request, open_router
from shared.config import BusConfig
from shared.halts.book import new_halt
from shared.halts.orders import order
from shared.keys import HALT, OBSERVATION
from shared.messages import PROTOCOL_VERSION, Halts, Observation, Standing
from shared.place import used
from shared.provenance import ROOT

LONG = True
HANGING, OTHERS = ("second", "third"), ("fourth", "fifth", "sixth", "seventh", "eighth")
RUN, LIFE = "stop-reaction", "a" * 12
SPINNING, AT_ONCE = 2, 10
COMMAND = Path(sys.executable).with_name("corridor")


class Fleet(Rig):
    """The rig, with drivers of simulated robots, of which some hang when they are told to."""

    def start_others(self) -> None:
        """Start them."""
        options = ("--config", str(self._file), "--run-dir", str(self.folder))
        for robot in (*HANGING, *OTHERS):
            settings = ("--set", f"robot.id={robot}", "--set", "robot.kind=sim")
            self._corridor(robot, "driver", *options, *settings)
        everybody = 1 + len(HANGING) + len(OTHERS)
        self.wait(lambda: len(self.bus.peers("driver")) == everybody, "all drivers are there")

    def reaction(self) -> tuple[float, float]:
        """Seconds until all healthy drivers say that they stand, and until zeros are at the robot.

        The others are frozen, and their roles are still their own.
        """
        self.wait_driving()
        for robot in HANGING:
            self.signal(robot, signal.SIGSTOP)
        at_s = time.monotonic()
        inbox = self.bus.inbox()
        inbox.ask_all(HALT, new_halt("estop", "", time.time_ns()), timeout_s=PATIENCE_S)
        standing = set[str]()
        while len(standing) <= len(OTHERS) and time.monotonic() < at_s + PATIENCE_S:
            inbox.wait(0.1)
            standing |= {answer.id for answer in inbox.answers(Standing) if answer.stands}
        stands_s = time.monotonic() - at_s
        assert len(standing) == 1 + len(OTHERS), (standing, self.log("driver"))
        zero_s = self.first_stop_s(at_s)
        for robot in HANGING:
            self.signal(robot, signal.SIGCONT)
        self.wait(lambda: order(self.bus, "clear", "", lambda _: None), "released")
        return stands_s, zero_s


def reactions(rounds: int) -> list[tuple[float, float]]:
    """Times of many halts; now and then from the start, before the robot gets stuck somewhere."""
    base = configuration()
    robot = base.robot.model_copy(update={"world": "plus"})  # that the simulated ones can drive in
    config = base.model_copy(update={"robot": robot})
    found: list[tuple[float, float]] = []
    while len(found) < rounds:
        with tempfile.TemporaryDirectory() as place, Fleet(config, Path(place) / "run") as rig:
            rig.start("router", "driver", "actor")
            rig.start_others()
            found += [rig.reaction() for _ in range(min(AT_ONCE, rounds - len(found)))]
    return found


def keys(rounds: int) -> list[float]:
    """Seconds from pressing space in the terminal of a run that trains until its halt is heard."""
    heard: queue.Queue[float] = queue.Queue()

    def note(request: Request) -> None:
        with request:
            heard.put(time.monotonic())

    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory())) / RUN
        up = [COMMAND, "up", "--run-dir", str(folder), "--set", f"run.name={RUN}"]
        person = stack.enter_context(Terminal([str(part) for part in up]))
        stack.callback(person.process.wait, PATIENCE_S)
        stack.callback(person.press, b"\x03")
        wait_until(lambda: "robot robotino1" in person.shown(), PATIENCE_S, "the robot is there")
        place = used(folder)
        assert place is not None
        bus = stack.enter_context(Bus(BusConfig(endpoint=place[0]), RUN))
        bus.serve(HALT, "main", note)
        inbox = bus.inbox()
        inbox.subscribe(OBSERVATION)
        return [_key(person, bus, inbox, heard) for _ in range(rounds)]


def _key(person: Terminal, bus: Bus, inbox: Inbox, heard: queue.Queue[float]) -> float:
    """One press, from a robot that moves to one that is released."""
    inbox.take(OBSERVATION, Observation)
    wait_until(lambda: len(inbox.take(OBSERVATION, Observation)) > 0, PATIENCE_S, "it moves")
    while not heard.empty():
        heard.get()
    at_s = time.monotonic()
    person.press(b" ")
    seconds = heard.get(timeout=PATIENCE_S) - at_s
    person.shown()
    wait_until(lambda: order(bus, "clear", "", lambda _: None), PATIENCE_S, "released")
    return seconds


def command(endpoint: str, heard: queue.Queue[tuple[float, Request]]) -> float:
    """Seconds from starting `corridor estop` until its halt arrives; it is answered to its end."""
    at_s = time.monotonic()
    with subprocess.Popen(
        [COMMAND, "estop", "--endpoint", endpoint, "--run", RUN],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
    ) as process:
        first_s = None
        while process.poll() is None:
            try:
                arrived_s, request = heard.get(timeout=0.1)
            except queue.Empty:
                assert time.monotonic() < at_s + PATIENCE_S, "corridor estop goes on for ever"
                continue
            first_s = arrived_s if first_s is None else first_s
            with request:
                request.read()
                assert isinstance(request.message, Halts)
                request.reply(
                    Standing(
                        service="driver",
                        id=HANGING[0],
                        life=LIFE,
                        clock_s=time.monotonic(),
                        state="estop",
                        stands=True,
                        halts=request.message.halts,
                    )
                )
    assert process.returncode == 0
    assert first_s is not None
    return first_s - at_s


def nothing() -> float:
    """Seconds that Python takes to start and end."""
    at_s = time.monotonic()
    subprocess.run([sys.executable, "-c", "pass"], check=True, cwd=ROOT)
    return time.monotonic() - at_s


def commands(rounds: int, busy: int) -> tuple[list[float], list[float]]:
    """Times of the command and of nothing, in turns, beside so many processes that only spin."""
    heard: queue.Queue[tuple[float, Request]] = queue.Queue()
    with ExitStack() as stack:
        endpoint = stack.enter_context(open_router("tcp/127.0.0.1:0"))
        bus = stack.enter_context(Bus(BusConfig(endpoint=endpoint), RUN))
        bus.serve(HALT, "main", lambda request: heard.put((time.monotonic(), request)))
        bus.announce("driver", HANGING[0], LIFE, PROTOCOL_VERSION, "0" * 16)
        for _ in range(busy):
            stack.enter_context(spinning())
        turns = [(command(endpoint, heard), nothing()) for _ in range(rounds)]
    return [ours for ours, _ in turns], [plain for _, plain in turns]


def measure(mode: Mode) -> tuple[list[list[object]], list[Bar]]:
    """Rows of times, and the bars P15a to P15e."""
    found = reactions(rounds_of(mode, 40, 200))
    rounds = rounds_of(mode, 10, 40)
    (idle, plain), (loaded, loaded_plain) = commands(rounds, 0), commands(rounds, SPINNING)
    pressed = keys(rounds)
    stands, zeros = [stands_s for stands_s, _ in found], [zero_s for _, zero_s in found]
    cases = {
        "six robots stand, two more drivers hang": stands,
        "zeros at one of them": zeros,
        "corridor estop is heard, idle": idle,
        "corridor estop is heard, beside two that spin": loaded,
        "space is heard, `corridor up` training": pressed,
        "python -c pass, idle": plain,
        "python -c pass, beside two that spin": loaded_plain,
    }
    rows: list[list[object]] = [
        [name, 1e3 * median(times), 1e3 * p99(times), 1e3 * max(times), len(times)]
        for name, times in cases.items()
    ]
    bars = [
        Bar("P15a", 1e3 * p99(stands), "ms p99", "lower", 100.0, 50.0, None, 1e3 * median(stands),
            len(stands)),
        Bar("P15b", 1e3 * p99(zeros), "ms p99", "lower", 50.0, 30.0, None, 1e3 * median(zeros),
            len(zeros)),
        Bar("P15c", 1e3 * median(idle), "ms", "lower", 200.0, 100.0, 1e3 * median(plain),
            1e3 * median(idle), len(idle), {"p99_ms": 1e3 * p99(idle)}),
        Bar("P15d", 1e3 * median(loaded), "ms", "lower", 600.0, 300.0, 1e3 * median(loaded_plain),
            1e3 * median(loaded), len(loaded), {"p99_ms": 1e3 * p99(loaded)}),
        Bar("P15e", 1e3 * median(pressed), "ms", "lower", 100.0, 50.0, None, 1e3 * median(pressed),
            len(pressed), {"p99_ms": 1e3 * p99(pressed)}),
    ]  # fmt: skip
    return rows, bars


def p99(times: Sequence[float]) -> float:
    """The 99th percentile."""
    return quantiles(times, n=100, method="inclusive")[98]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and report."""
    rows, bars = measure(mode_of(arguments, __doc__))
    head = ["what", "median ms", "p99 ms", "longest ms", "n"]
    report("Reaction to a stop", [table(head, rows)], bars)


if __name__ == "__main__":
    main()
