"""The one table of a run's processes: what each needs, and in which order they start and stop.

The command line, `corridor up`, status, stop, health checks and the tests of the container images
read it. Recording and driving without learning are commands that join a run; they are not in it.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass

COMMAND = (sys.executable, "-P", "-m", "services.cli")
"""Start of a child's command line; with -P a folder `services` where the user stands is ignored."""
MAIN = "main"
"""Id of every service of which a run has only one."""


@dataclass(frozen=True)
class Process:
    """One kind of process."""

    name: str
    """Its command, the service it announces itself as, and its container image."""
    package: str
    """Folder below `services` that holds its `service.py`."""
    purpose: str
    """What it does, in one sentence for `--help`."""
    extras: tuple[str, ...]
    """What to install. Of several, each is for one kind of robot, and the first is the default."""
    stop_stage: int
    """Place in the order of stopping, from 0; processes of one stage stop at the same time."""
    may_finish: bool = True
    """Whether exit code 0 means that it is done; otherwise it is restarted."""
    patience: int = 1
    """How many times `bus.hang_s` it may be silent: more where one step of its work takes long."""
    per_robot: bool = False
    """Whether every robot has one of its own, whose id is that of the robot."""

    @property
    def module(self) -> str:
        """The module whose `run` does the work."""
        return f"services.{self.package}.service"

    @property
    def images(self) -> tuple[str, ...]:
        """Names of its container images: one, or one for each kind of robot."""
        if len(self.extras) > 1:
            return tuple(f"{self.name}-{extra}" for extra in self.extras)
        return (self.name,)

    def ident(self, robot: str, robots: Sequence[str] = ()) -> str:
        """The id under which a process announces itself.

        robot: that a driver drives; robots: that an actor serves, if it does not serve all.
        """
        if self.per_robot:
            return robot
        return robots[0] if self.name == "actor" and robots else MAIN


ROUTER = Process(
    "router",
    "router",
    "Run a Zenoh router; the first line on standard output is where it listens.",
    extras=(),
    stop_stage=3,
    may_finish=False,
)
REPLAY = Process(
    "replay",
    "replay",
    "Keep the replay memory on disk: store, discard, equalise, serve changes.",
    extras=("replay",),
    stop_stage=2,
    patience=5,  # a transaction over the whole memory
)
LEARNER = Process(
    "learner",
    "learner",
    "Train the network, keep checkpoints, publish the target network.",
    extras=("learner",),
    stop_stage=2,
    patience=5,  # two transfers of the memory of up to a minute each, a checkpoint
)
ACTOR = Process(
    "actor",
    "actor",
    "Choose actions with the target network and hand episodes to replay.",
    extras=("actor",),
    stop_stage=1,
)
DRIVER = Process(
    "driver",
    "robot_driver",
    "Drive one robot: camera, motion, limits, bumper reflex, emergency stop.",
    extras=("sim", "robotino", "ros2"),
    stop_stage=0,
    per_robot=True,
)

SERVICES = (REPLAY, LEARNER, ACTOR, DRIVER)
"""In the order of starting. They are asked to stop in the opposite order."""
PROCESSES = (ROUTER, *SERVICES)
BY_NAME = {process.name: process for process in PROCESSES}
