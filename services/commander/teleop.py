"""`corridor teleop`: place a robot by keys from the terminal, with a deadman.

It answers the robot's observations as an actor would, so every limit of the driver holds: speeds
are cut, contact stops, silence stops. The robot creeps and turns on the spot; it does nothing else.
"""

import sys
import time
from collections.abc import Callable
from functools import partial

from services.commander.commander import Commander, commanding
from services.commander.keyboard import MOTIONS
from services.commander.terminal import Keys, emergency_stop, require_terminal, single_keys
from shared.config import Config
from shared.messages import Motion, Observation

POLL_S = 0.02
"""How often keys and observations are looked at."""
PACE = 0.9
"""Least time between two answers, in periods: in lockstep, time itself waits for answers."""
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
    require_terminal("teleop")
    with commanding(config, robot) as commander:
        echo(f"{commander.robot}: {HELP}")
        with single_keys(sys.stdin.fileno()) as descriptor:
            Teleop(commander, descriptor, echo).run()
    return 0


class Teleop:
    """One thread: keys in, answers out."""

    def __init__(self, commander: Commander, descriptor: int, echo: Callable[[str], None]) -> None:
        self._commander, self._echo = commander, echo
        stop = partial(emergency_stop, commander.bus, commander.robot, echo)
        self._keys: Keys[Motion] = Keys(descriptor, MOTIONS, "", stop)
        self._waiting: Observation | None = None
        self._answered_s = 0.0
        self._shown = ""

    def run(self) -> None:
        """Answer keys until the person quits, the terminal closes, or a signal comes."""
        while not self._commander.stop.is_set() and self._keys.read():
            self._waiting = self._commander.observe(POLL_S) or self._waiting
            self._answer()

    def _answer(self) -> None:
        """Answer the observation that waits, if it is time."""
        now_s, observation = time.monotonic(), self._waiting
        if observation is None or now_s < self._answered_s + PACE * observation.period_s:
            return
        motion = self._keys.wanted()
        self._commander.answer(observation, motion=motion, by="human")
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
