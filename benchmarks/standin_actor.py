"""A stand-in for the actor, run as a script: answers every observation at once, always the same.

Arguments: router, run, action. It needs neither learner nor replay, and starts in a second.
"""

from __future__ import annotations

import sys

from services.launcher.tether import tether
from shared.bus import Bus
from shared.config import BusConfig
from shared.keys import ACTION, OBSERVATION
from shared.messages import Action, Observation


def main() -> None:
    tether()
    endpoint, run, action = sys.argv[1:]
    with Bus(BusConfig(endpoint=endpoint), run) as bus:
        inbox = bus.inbox()
        inbox.subscribe(OBSERVATION)
        while True:
            inbox.wait(0.2)
            for robot, seen in inbox.take(OBSERVATION, Observation):
                bus.publish(ACTION, answer(seen, int(action)), robot)


def answer(seen: Observation, action: int) -> Action:
    """The action that answers this observation."""
    return Action(
        robot=seen.robot,
        actor_life="a" * 12,
        robot_life=seen.life,
        sequence=seen.sequence,
        attempt=seen.attempt,
        action=action,
        by="network",
        values=(0.0, 0.0, 0.0),
        weights_version=1,
    )


if __name__ == "__main__":
    main()
