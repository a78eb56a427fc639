"""`corridor takeover`: a person drives a robot while it learns, and gives it back.

The actor goes on answering the robot; it takes the person's wish in place of the network's choice,
and the samples say so. A wish is for a moment only: the robot stands without another one.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial

from services.commander.commander import choose_robot
from services.commander.keyboard import WISHES
from services.commander.terminal import Keys, emergency_stop, require_terminal, single_keys
from services.processes import MAIN
from shared.bus import Bus
from shared.config import Config
from shared.errors import PeerMissing
from shared.facts import ACTIONS, FORWARD, FORWARD_LEFT, FORWARD_RIGHT
from shared.keys import ACTOR_STATE, TAKEOVER
from shared.messages import ActorState, Takeover
from shared.service import StopFlag, answer_signals, new_life

WISH_PERIOD_S = 0.05
"""How often a wish is said again."""
FAREWELL_S = 3.0
"""How long the actor is told that the robot is given back, until it shows that it knows."""
HELP = (
    f"w or up: {ACTIONS[FORWARD].name}   a or left: {ACTIONS[FORWARD_LEFT].name}   "
    f"d or right: {ACTIONS[FORWARD_RIGHT].name}   let go: stand   "
    "e: emergency stop (corridor clear)   q: give the robot back to its network"
)


class Person:
    """Says what a person wants of one robot. One thread."""

    def __init__(self, bus: Bus, robot: str, before: Person | None = None) -> None:
        """before: the same person on another connection."""
        self.bus, self._robot = bus, robot
        self.life: str = before.life if before else new_life()
        self._number: int = before._number if before else 0

    def say(self, action: int | None, *, give_back: bool = False) -> None:
        """Wish for an action, or None: to stand. Say it again within `WISH_PERIOD_S`."""
        self._number += 1
        message = Takeover(
            robot=self._robot,
            life=self.life,
            number=self._number,
            action=action,
            give_back=give_back,
        )
        self.bus.publish(TAKEOVER, message, self._robot)


def run(config: Config, robot: str | None, echo: Callable[[str], None]) -> int:
    """Let a person at this terminal drive a robot that learns, until `q` gives it back.

    However else it ends, the robot stands until somebody takes it over and gives it back.

    Args:
        config: How to reach the run.
        robot: Which robot; None: the only one there is.
        echo: Shows a line.

    Returns:
        The exit code: 1 if the robot was not given back.

    Raises:
        ConfigError: Standard input is no terminal, or there is no such robot to choose.
        PeerMissing: There is no robot, or no actor serves it.
        RouterMissing: There is no router.
    """
    require_terminal("takeover")
    stop = StopFlag()
    answer_signals(stop)
    with Bus(config.bus, config.run.name) as bus:
        robot, _ = choose_robot(config, bus.peers(), robot)
        talk = _Talk(bus, robot, stop, echo)
        with single_keys(sys.stdin.fileno()) as descriptor:
            quits = talk.drive(descriptor)
        if quits and talk.give_back():
            echo(f"{robot}: given back to its network")
            return 0
    echo(f"{robot}: stands until it is given back: corridor takeover, then q")
    return 1


class _Talk:
    """Wishes out, heartbeats of the actor in."""

    def __init__(self, bus: Bus, robot: str, stop: StopFlag, echo: Callable[[str], None]) -> None:
        self._bus, self._robot, self._stop, self._echo = bus, robot, stop, echo
        self._person = Person(bus, robot)
        self._inbox = bus.inbox()
        self._inbox.subscribe(ACTOR_STATE, robot)
        self._actor: ActorState | None = None
        self._shown = ""

    def drive(self, descriptor: int) -> bool:
        """Say what the keys want; True if the person quits, False at a signal or without keys."""
        stop = partial(emergency_stop, self._bus, self._robot, self._echo)
        keys: Keys[int | None] = Keys(descriptor, WISHES, None, stop)
        self._echo(f"{self._robot}: {HELP}")
        silent_s = time.monotonic() + FAREWELL_S
        while not self._stop.is_set():
            if not keys.read(WISH_PERIOD_S):
                return keys.quits
            action = keys.wanted()
            self._person.say(action)
            self._listen()
            if self._actor is None and time.monotonic() > silent_s:
                raise PeerMissing(f"no actor {MAIN!r} serves robot {self._robot!r}")
            self._show(action)
        return False

    def give_back(self) -> bool:
        """Tell the actor until it shows that it knows; whether it does."""
        until_s, self._actor = time.monotonic() + FAREWELL_S, None
        while time.monotonic() < until_s:
            self._person.say(None, give_back=True)
            self._inbox.wait(WISH_PERIOD_S)
            self._listen()
            if self._actor is not None and not self._actor.taken_over:
                return True
        return False

    def _listen(self) -> None:
        for _, state in self._inbox.take(ACTOR_STATE, ActorState):
            self._actor = state

    def _show(self, action: int | None) -> None:
        """One line whenever something else happens than before."""
        actor = self._actor
        if actor is not None and actor.taken_over and actor.person != self._person.life:
            shown = "somebody else drives it"
        else:
            shown = "stands" if action is None else ACTIONS[action].name
        if shown != self._shown:
            self._shown = shown
            share = f", {actor.human_actions} of {actor.actions} by persons" if actor else ""
            self._echo(f"{self._robot}: {shown}{share}")
