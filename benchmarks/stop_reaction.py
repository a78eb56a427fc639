"""P15: how soon a robot stops while another driver hangs, and how soon `corridor estop` is heard.

A driver of an emulated Robotino drives it; the driver of a second, simulated robot is frozen just
before a halt is sent to all. What counts is the time from sending it until the first driver says
that its robot stands, and until zero velocity has reached the robot. The command is started as an
operator would start it, on a machine that is idle and beside two processes that only spin; beside
it, the time that Python takes to do nothing.

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
from shared.bus import Bus, Request, open_router
from shared.config import BusConfig
from shared.halts.book import new_halt
from shared.halts.orders import release
from shared.keys import HALT
from shared.messages import PROTOCOL_VERSION, Halts, Standing
from shared.provenance import ROOT

LONG = True
OTHER, RUN, LIFE = "second", "stop-reaction", "a" * 12
SPINNING, AT_ONCE = 2, 10
COMMAND = Path(sys.executable).with_name("corridor")


class Pair(Rig):
    """The rig, with a second driver that hangs when it is told to."""

    def start_other(self) -> None:
        """Start the driver of a simulated robot."""
        options = ("--config", str(self._file), "--run-dir", str(self.folder))
        robot = ("--set", f"robot.id={OTHER}", "--set", "robot.kind=sim")
        self._corridor("other", "driver", *options, *robot)

    def reaction(self) -> tuple[float, float]:
        """Seconds until the healthy driver says that it stands, and until zeros are at its robot.

        The other driver is frozen, and its role is still its own.
        """
        self.wait(lambda: len(self.bus.peers("driver")) == 2, "both drivers are there")
        self.wait_driving()
        self.signal("other", signal.SIGSTOP)
        at_s = time.monotonic()
        inbox = self.bus.inbox()
        inbox.ask_all(HALT, new_halt("estop", "", time.time_ns()), timeout_s=PATIENCE_S)
        stands = False
        while not stands and time.monotonic() < at_s + PATIENCE_S:
            inbox.wait(0.1)
            stands = any(answer.stands for answer in inbox.answers(Standing))
        stands_s = time.monotonic() - at_s
        assert stands, self.log("driver")
        zero_s = self.first_stop_s(at_s)
        self.signal("other", signal.SIGCONT)
        self.wait(lambda: release(self.bus, "estop", "", lambda _: None), "released")
        return stands_s, zero_s


def reactions(rounds: int) -> list[tuple[float, float]]:
    """Times of many halts; now and then from the start, before the robot gets stuck somewhere."""
    base = configuration()
    robot = base.robot.model_copy(update={"world": "plus"})  # that the simulated one can drive in
    config = base.model_copy(update={"robot": robot})
    found: list[tuple[float, float]] = []
    while len(found) < rounds:
        with tempfile.TemporaryDirectory() as place, Pair(config, Path(place) / "run") as rig:
            rig.start("router", "driver", "actor")
            rig.start_other()
            found += [rig.reaction() for _ in range(min(AT_ONCE, rounds - len(found)))]
    return found


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
                        id=OTHER,
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
        bus.announce("driver", OTHER, LIFE, PROTOCOL_VERSION, "0" * 16)
        for _ in range(busy):
            stack.enter_context(spinning())
        turns = [(command(endpoint, heard), nothing()) for _ in range(rounds)]
    return [ours for ours, _ in turns], [plain for _, plain in turns]


def measure(mode: Mode) -> tuple[list[list[object]], list[Bar]]:
    """Rows of times, and the bars P15a to P15d."""
    found = reactions(rounds_of(mode, 40, 200))
    rounds = rounds_of(mode, 10, 40)
    (idle, plain), (loaded, loaded_plain) = commands(rounds, 0), commands(rounds, SPINNING)
    stands, zeros = [stands_s for stands_s, _ in found], [zero_s for _, zero_s in found]
    cases = {
        "a robot stands, another driver hangs": stands,
        "zeros at that robot": zeros,
        "corridor estop is heard, idle": idle,
        "corridor estop is heard, beside two that spin": loaded,
        "python -c pass, idle": plain,
        "python -c pass, beside two that spin": loaded_plain,
    }
    rows: list[list[object]] = [
        [name, 1e3 * median(times), 1e3 * p99(times), 1e3 * max(times), len(times)]
        for name, times in cases.items()
    ]
    bars = [
        Bar("P15a", 1e3 * p99(stands), "ms p99", "lower", 50.0, 30.0, None, 1e3 * median(stands),
            len(stands)),
        Bar("P15b", 1e3 * p99(zeros), "ms p99", "lower", 50.0, 30.0, None, 1e3 * median(zeros),
            len(zeros)),
        Bar("P15c", 1e3 * median(idle), "ms", "lower", 200.0, 100.0, 1e3 * median(plain),
            1e3 * median(idle), len(idle), {"p99_ms": 1e3 * p99(idle)}),
        Bar("P15d", 1e3 * median(loaded), "ms", "lower", 600.0, 300.0, 1e3 * median(loaded_plain),
            1e3 * median(loaded), len(loaded), {"p99_ms": 1e3 * p99(loaded)}),
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
