"""Health check of one service, for containers: `python -m services.monitor.health replay`.

Healthy means doing its job: the service answers a ping, and its heartbeat, which its working thread
sends, comes as well. What it does now is told in one line: a driver whose robot stands still since
a sensor is silent is healthy, and says so; restarting it would help nobody. An actor has heartbeats
only for robots that send observations, so without such robots the ping alone counts. The router is
healthy when it accepts a session.
"""

import os
import sys
import time

from services.monitor.heartbeats import Reader, Snapshot
from services.monitor.words import learner_doing, replay_doing
from services.processes import ACTOR, BY_NAME, DRIVER, LEARNER, REPLAY, ROUTER
from shared import settings
from shared.bus import Bus
from shared.config import Config
from shared.errors import BadMessage, BusError, ConfigError, not_among
from shared.keys import PING
from shared.messages import Ping, ServiceReply

PERIODS = 3
"""Heartbeat periods after which silence counts as sick."""
OBSERVING = {"waiting", "driving", "recovering"}
"""States of a robot in which its driver sends observations and so needs an actor."""


class Sick(Exception):
    """Why a service is not healthy, in one line."""


def check(name: str, config: Config) -> str:
    """What the service does now, in one line.

    Args:
        name: a process of a run; the driver is that of `robot.id`.
        config: how to reach the run.

    Raises:
        Sick: it does not do its job.
    """
    if name not in BY_NAME:
        raise Sick(str(not_among("service", name, BY_NAME)))
    try:
        with Bus(config.bus, config.run.name) as bus:
            return "accepts sessions" if name == ROUTER.name else _doing(bus, name, config)
    except (BusError, BadMessage) as error:
        raise Sick(str(error)) from error


def _doing(bus: Bus, name: str, config: Config) -> str:
    """Ping the service and wait for its heartbeat. Raises BusError when it does not answer."""
    ident = BY_NAME[name].ident(config.robot.id, config.run.robots)
    inbox = bus.inbox()
    reader = Reader(inbox, robot=ident if name == DRIVER.name else "*")
    bus.request(PING, Ping(), ServiceReply, ident=f"{name}-{ident}")
    deadline_s = time.monotonic() + PERIODS * config.bus.heartbeat_s
    while time.monotonic() < deadline_s:
        inbox.wait(0.1)
        reader.update()
        if told := _told(name, ident, reader.snapshot()):
            return told
    if name == ACTOR.name and not _needs_actor(reader.snapshot()):
        return "waits for a robot"
    raise Sick(f"{name} {ident}: answers, but sent no heartbeat for {PERIODS} periods")


def _told(name: str, ident: str, seen: Snapshot) -> str:
    """What the service's heartbeat says; empty while there is none."""
    if name == DRIVER.name and ident in seen.robots:
        robot = seen.robots[ident].message
        return f"{robot.state}, {robot.reason}" if robot.reason else robot.state
    if name == ACTOR.name and seen.actors:
        actors = (entry.message for entry in seen.actors.values())
        return ", ".join(f"{actor.phase} for {actor.robot}" for actor in actors)
    if name == REPLAY.name and seen.replay:
        return f"{replay_doing(seen.replay.message)}, episode {seen.replay.message.episode}"
    if name == LEARNER.name and seen.learner:
        return f"{learner_doing(seen.learner.message)}, episode {seen.learner.message.episode}"
    return ""


def _needs_actor(seen: Snapshot) -> bool:
    """Whether a robot sends observations, so that a working actor would send heartbeats."""
    return any(robot.message.state in OBSERVING for robot in seen.robots.values())


def main(arguments: list[str]) -> int:
    """Check the named service as the environment says; 0 healthy, 1 not, each with one line."""
    try:
        config = settings.load(env=os.environ)
        sys.stdout.write(f"{check(arguments[0] if arguments else '', config)}\n")
    except (ConfigError, Sick) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
