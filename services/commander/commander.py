"""Commanding one robot in the place of an actor: a frozen network or a person, one at a time.

To the driver it is an actor: it answers observations. Others see it as the service `actor` whose id
is that of the robot; the actor of a run, `main`, serves all of them.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from services.processes import ACTOR, DRIVER, MAIN
from shared import roles
from shared.bus import Bus
from shared.config import Config
from shared.errors import ConfigError, PeerMissing, RobotTaken
from shared.facts import ACTION_COUNT, NAME, Chooser
from shared.inbox import Inbox
from shared.keys import ACTION, OBSERVATION, Peer
from shared.messages import PROTOCOL_VERSION, Action, Motion, Observation
from shared.service import TICK_S, Service, StopFlag, answer_signals, controlled, new_life

LOOK_ROUND_S = 1.0
"""How often a commander looks whether it is still the only one."""
FAREWELL_S = 0.6
"""How long a commander that leaves waits for the robot's next look, to answer it with a hold."""
NO_VALUES = (0.0,) * ACTION_COUNT


class Commander:
    """Answers the observations of one robot. All methods belong to one thread."""

    def __init__(self, me: Service, robot: str) -> None:
        self._me, self.robot = me, robot
        self._inbox: Inbox = me.bus.inbox()
        self._inbox.subscribe(OBSERVATION, robot)
        me.stop.on_set(self._inbox.wake)
        self._answered: tuple[tuple[str, int, int], Action] | None = None
        self._look_s = 0.0

    @property
    def bus(self) -> Bus:
        """The bus, for requests beside the answers."""
        return self._me.bus

    @property
    def stop(self) -> StopFlag:
        """Set by signals and by `corridor stop`."""
        return self._me.stop

    def observe(self, timeout_s: float) -> Observation | None:
        """The newest observation that waits for an answer; None when none came in time.

        One that was answered already has not reached the driver: the answer is sent again. Raises
        RobotTaken when somebody else began to command the robot.
        """
        self._look_round()
        self._inbox.wait(timeout_s)
        for _, observation in self._inbox.take(OBSERVATION, Observation):
            if self._answered is None or self._answered[0] != _place(observation):
                return observation
            self.bus.publish(ACTION, self._answered[1], self.robot)
        return None

    def answer(
        self,
        observation: Observation,
        action: int | None = None,
        motion: Motion = "",
        values: tuple[float, ...] = NO_VALUES,
        by: Chooser = "network",
    ) -> None:
        """Answer an observation: an action, a motion, or neither: hold still."""
        message = Action(
            robot=self.robot,
            actor_life=self._me.life,
            robot_life=observation.life,
            sequence=observation.sequence,
            attempt=observation.attempt,
            action=action,
            motion=motion,
            by=by,
            values=values,
            weights_version=0,
        )
        self._answered = (_place(observation), message)
        self.bus.publish(ACTION, message, self.robot)

    def leave(self) -> None:
        """Let the robot stand: answer its next look, if one comes soon, with a hold.

        Without it a robot in real time stops one period later, as when an answer is late.
        """
        deadline_s = time.monotonic() + FAREWELL_S
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            self._inbox.wait(min(left_s, TICK_S))
            for _, observation in self._inbox.take(OBSERVATION, Observation):
                if self._answered is None or self._answered[0] != _place(observation):
                    self.answer(observation)
                    return

    def _look_round(self) -> None:
        now_s = time.monotonic()
        if now_s >= self._look_s:
            self._look_s = now_s + LOOK_ROUND_S
            refuse_others(self.bus.peers(timeout_s=0.5), self.robot, self._me.life)


@contextmanager
def commanding(config: Config, robot: str | None) -> Iterator[Commander]:
    """Be the one who commands a robot while the block runs; it is left standing.

    Args:
        config: How to reach the run.
        robot: Which robot; None: the only one there is.

    Raises:
        ConfigError: `robot` is not a name, was left out though there are several, or its driver
            speaks another protocol.
        PeerMissing: There is no robot.
        RobotTaken, RoleTaken: Somebody else commands it.
        RouterMissing: There is no router.
    """
    stop = StopFlag()
    answer_signals(stop)
    with Bus(config.bus, config.run.name) as bus:
        peers = bus.peers()
        robot, fingerprint = choose_robot(config, peers, robot)
        life = new_life()
        refuse_others(peers, robot, life)
        me = Service(ACTOR.name, robot, life, config, bus, stop)
        # Whatever the robot is configured to do is right for who only answers it.
        with roles.claimed(bus, ACTOR.name, robot, life):
            bus.announce(ACTOR.name, robot, life, PROTOCOL_VERSION, fingerprint)
        with controlled(me):
            commander = Commander(me, robot)
            try:
                yield commander
            finally:
                commander.leave()


def refuse_others(peers: list[Peer], robot: str, life: str) -> None:
    """Raise RobotTaken if anybody but `life` answers this robot."""
    for peer in peers:
        if peer.service == ACTOR.name and peer.id in (MAIN, robot) and peer.life != life:
            hint = "corridor stop --service actor" if peer.id == MAIN else "Ctrl-C there"
            raise RobotTaken(
                f"robot {robot!r} is commanded by actor {peer.id!r} (life {peer.life}): "
                f"end it first ({hint})"
            )


def choose_robot(config: Config, peers: list[Peer], robot: str | None) -> tuple[str, str]:
    """The robot that is meant, and the fingerprint of its configuration.

    Raises ConfigError and PeerMissing as `commanding` does.
    """
    drivers = {peer.id: peer for peer in peers if peer.service == DRIVER.name}
    if robot is None:
        if not drivers:
            raise PeerMissing(
                f"no robot of run {config.run.name!r} answers at {config.bus.endpoint}"
            )
        if len(drivers) > 1:
            raise ConfigError(f"--robot: expected one of {', '.join(sorted(drivers))}, got none")
        robot = next(iter(drivers))
    if not NAME.fullmatch(robot):
        raise ConfigError(f"--robot: expected a name like {NAME.pattern}, got {robot!r}")
    driver = drivers.get(robot)
    if driver is None:  # drivers of others need no token
        return robot, config.fingerprint()
    if driver.protocol != str(PROTOCOL_VERSION):
        raise ConfigError(
            f"driver {robot!r} speaks protocol {driver.protocol}, this is {PROTOCOL_VERSION}"
        )
    return robot, driver.config


def _place(observation: Observation) -> tuple[str, int, int]:
    return (observation.life, observation.sequence, observation.attempt)
