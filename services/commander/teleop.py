"""`corridor teleop`: place a robot by keys from the terminal, with a deadman.

It answers the robot's observations as an actor would, so every limit of the driver holds: speeds
are cut, contact stops, silence stops. The robot creeps and turns on the spot; it does nothing else.
"""

import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from services.commander.commander import Commander, commanding
from services.commander.keyboard import KeyParser, Wish
from shared.config import Config
from shared.errors import ConfigError, PeerMissing
from shared.halts.orders import halt
from shared.messages import Motion, Observation

POLL_S = 0.02
"""How often keys and observations are looked at."""
PACE = 0.9
"""Least time between two answers, in periods: in lockstep, time itself waits for answers."""
ESTOP_S = 3.0
"""The driver is told of an emergency stop again and again for so long."""
READ_BYTES = 256
HELP = (
    "w/s or up/down: forward/back   a/d or left/right: turn   space: stop   "
    "e: emergency stop (corridor clear)   q: quit"
)


def run(config: Config, robot: str | None, echo: Callable[[str], None]) -> int:
    """Let a person at this terminal move a robot until `q` or Ctrl-C; the exit code.

    Raises:
        ConfigError: Standard input is no terminal, or there is no such robot to choose.
        PeerMissing, RobotTaken or RouterMissing: See `commanding`.
    """
    if not sys.stdin.isatty():
        raise ConfigError("teleop: expected a terminal as standard input, for its keys")
    with commanding(config, robot) as commander:
        echo(f"{commander.robot}: {HELP}")
        with single_keys(sys.stdin.fileno()) as descriptor:
            Teleop(commander, descriptor, echo).run()
    return 0


@contextmanager
def single_keys(descriptor: int) -> Iterator[int]:
    """Have a terminal give every key at once, unshown, while the block runs; Ctrl-C still stops."""
    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor, termios.TCSANOW)
        yield descriptor
    finally:
        with suppress(termios.error):  # it may be gone
            termios.tcsetattr(descriptor, termios.TCSANOW, before)


class Teleop:
    """One thread: keys in, answers out."""

    def __init__(self, commander: Commander, descriptor: int, echo: Callable[[str], None]) -> None:
        self._commander, self._descriptor, self._echo = commander, descriptor, echo
        self._keys, self._wish = KeyParser(), Wish()
        self._waiting: Observation | None = None
        self._answered_s = 0.0
        self._shown = ""

    def run(self) -> None:
        """Answer keys until the person quits, the terminal closes, or a signal comes."""
        while not self._commander.stop.is_set():
            if not self._read():
                return
            command = self._wish.take_command()
            if command == "quit":
                return
            if command == "estop":
                self._estop()
            self._waiting = self._commander.observe(POLL_S) or self._waiting
            self._answer()

    def _read(self) -> bool:
        """Take the keys pressed since; False when the terminal is gone."""
        ready, _, _ = select.select([self._descriptor], [], [], 0.0)
        if ready:
            try:
                data = os.read(self._descriptor, READ_BYTES)
            except OSError:
                return False
            if not data:
                return False
            now_s = time.monotonic()
            for key in self._keys.feed(data):
                self._wish.press(key, now_s)
        return True

    def _answer(self) -> None:
        """Answer the observation that waits, if it is time."""
        now_s, observation = time.monotonic(), self._waiting
        if observation is None or now_s < self._answered_s + PACE * observation.period_s:
            return
        motion = self._wish.motion(now_s)
        self._commander.answer(observation, motion=motion)
        self._waiting, self._answered_s = None, now_s
        self._show(observation, motion)

    def _show(self, observation: Observation, motion: Motion) -> None:
        """One line whenever something else happens than before."""
        contact = " CONTACT" if observation.bump else ""
        shown = f"{motion or 'stands'}{contact}"
        if shown != self._shown:
            self._shown = shown
            self._echo(
                f"{self._commander.robot}: {shown}  x {observation.x_m:.2f} m, y "
                f"{observation.y_m:.2f} m, heading {observation.heading_rad:+.2f} rad"
            )

    def _estop(self) -> None:
        """Tell the driver to stop and stay stopped; meanwhile it hears nothing, and stops, too."""
        robot, until_s = self._commander.robot, time.monotonic() + ESTOP_S
        stands, bus = False, self._commander.bus
        with suppress(PeerMissing):
            stands = halt(bus, "estop", robot, self._echo, ended=lambda: time.monotonic() > until_s)
        what = "corridor clear releases it" if stands else "no answer, press e again"
        self._echo(f"{robot}: emergency stop: {what}")
