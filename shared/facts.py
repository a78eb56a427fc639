"""Facts that everything else follows from: the image, the actions, the pattern of names."""

import re
from typing import Literal, NamedTuple, get_args

IMAGE_HEIGHT, IMAGE_WIDTH = 50, 75
"""Pixels of the grey image that the network sees (A22)."""
IMAGE_SHAPE = (IMAGE_HEIGHT, IMAGE_WIDTH)
IMAGE_BYTES = IMAGE_HEIGHT * IMAGE_WIDTH


class ActionKind(NamedTuple):
    """One of the robot's actions. Every action drives forward; some turn as well."""

    name: str
    """Name for people and reports, such as "forward/left"."""
    short: str
    """One word for columns and narrow tables, such as "left". It is unique."""
    vector: tuple[float, ...]
    """What the network gets as its second input (A21). All vectors have one length."""
    turn: float
    """Turn as a share of the turn rate: 1 full left (anticlockwise), 0 none, -1 full right."""
    mirror: str
    """`short` of the action that does the same in a mirror."""


ACTIONS = (
    ActionKind("forward", "forward", (1.0, 0.0, 0.0), 0, "forward"),
    ActionKind("forward/left", "left", (1.0, 1.0, 0.0), 1, "right"),
    ActionKind("forward/right", "right", (1.0, 0.0, 1.0), -1, "left"),
)
"""The action set (A21). The first bit of a vector is always 1 and kept for shape fidelity (E35)."""
ACTION_COUNT = len(ACTIONS)
ACTION_BITS = len(ACTIONS[0].vector)
SHORT_NAMES = tuple(action.short for action in ACTIONS)
FORWARD, FORWARD_LEFT, FORWARD_RIGHT = (SHORT_NAMES.index(s) for s in ("forward", "left", "right"))
MIRRORED = tuple(SHORT_NAMES.index(action.mirror) for action in ACTIONS)
"""Number of each action as it looks in a mirror."""

Chooser = Literal["network", "chance", "human"]
"""Who chose an action: the network's prediction, chance (to explore or to fill), a person."""
CHOOSERS = get_args(Chooser)
HUMAN = CHOOSERS.index("human")

PROTOCOL_VERSION = 3
"""Of messages and keys: who speaks another one is refused."""
DEFAULT_RUN, DEFAULT_ENDPOINT = "demo", "tcp/127.0.0.1:7447"
"""Name of a run, and where its router is, if nobody says otherwise."""
NAME = re.compile(r"^[a-z0-9][a-z0-9_-]{0,40}$")
"""What runs, robots, worlds and obstacles may be called: safe in keys and in file names."""
