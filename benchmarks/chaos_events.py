"""What happens to a run in `benchmarks/chaos.py`: events drawn from a seed, and nothing else."""

from __future__ import annotations

import random
from dataclasses import dataclass

from shared.halts.orders import RobotOrder

SECOND = "second"
ROBOTS = ("robotino1", SECOND)
ROLES = {
    "replay": ("replay", "main"),
    "learner": ("learner", "main"),
    "actor": ("actor", "main"),
    "driver": ("driver", ROBOTS[0]),
    f"driver-{SECOND}": ("driver", SECOND),
}
"""Processes of the run, with what they announce themselves as."""
PROCESSES = ("router", *ROLES)
MOVABLE = ("actor", "driver", f"driver-{SECOND}")
"""What may take over a role from another folder; the memory and the networks are only in one."""
KINDS = {
    "kill": 30, "freeze": 20, "duplicate": 12, "stop": 12, "router": 6, "estop": 8, "pause": 5,
    "kill all": 2,
}  # fmt: skip
RELEASES: dict[str, RobotOrder] = {"estop": "clear", "pause": "resume"}


@dataclass(frozen=True)
class Event:
    """One thing that happens, with everything that was drawn for it."""

    kind: str
    target: str
    """A process; of orders a robot, or empty for all."""
    lasts_s: float
    """How long something is frozen, or the router away."""
    restart_s: float
    """How soon what ended is started again."""
    pause_s: float
    """Until the next event."""
    elsewhere: bool = False
    """A duplicate runs in another folder."""


def draw(seed: int, count: int) -> list[Event]:
    """The events of a seed. A halt lasts for one to four others, in which drivers suffer most."""
    draws = random.Random(seed)  # noqa: S311
    plan: list[Event] = []
    in_force: dict[str, tuple[int, str]] = {}
    while len(plan) < count:
        due = [kind for kind, (until, _) in in_force.items() if len(plan) >= until]
        kinds = {kind: weight for kind, weight in KINDS.items() if kind not in in_force}
        if in_force:
            kinds["kill all"] = 6
        kind = RELEASES[due[0]] if due else draws.choices(list(kinds), list(kinds.values()))[0]
        targets = [*PROCESSES, *(MOVABLE if in_force else ())]
        target = draws.choice(targets[1:] if kind == "duplicate" else targets)
        if due:
            target = in_force.pop(due[0])[1]
        elif kind in RELEASES:
            target = draws.choice(("", "", *ROBOTS))
            in_force[kind] = (len(plan) + draws.randint(2, 5), target)
        lasts_s = draws.uniform(0.1, 6.0) if kind == "freeze" else draws.uniform(0.0, 5.0)
        plan.append(
            Event(
                *(kind, target, lasts_s, draws.uniform(0.0, 1.0), draws.uniform(0.0, 1.0)),
                elsewhere=draws.random() < 0.5,
            )
        )
    return plan
