"""What other tools show of a run: images, poses, worlds and predictions in Foxglove's schemas.

A recording has them beside the messages of the protocol from which they are made. Playback does not
read them. An image is the same bytes in both, so that compression stores it once.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from foxglove import Schema
from foxglove.messages import (
    Color,
    CubePrimitive,
    FrameTransform,
    Pose,
    PoseInFrame,
    Quaternion,
    RawImage,
    SceneEntity,
    SceneUpdate,
    Timestamp,
    Vector3,
)

from shared.facts import ACTIONS, IMAGE_HEIGHT, IMAGE_WIDTH, SHORT_NAMES
from shared.messages import Action, Box, Message, Observation

Solids = Callable[[str], Sequence[Box]]
"""Walls and boxes of a world, by its name."""
WORLD_FRAME = "world"
_NUMBERS = (*SHORT_NAMES, "action", "greedy", "weights_version", "episode")
PREDICTION = Schema(
    name="corridor.Prediction",
    encoding="jsonschema",
    data=json.dumps(
        {"type": "object", "properties": {name: {"type": "number"} for name in _NUMBERS}}
    ).encode(),
)


def no_solids(_: str) -> Sequence[Box]:
    """Around a robot whose world nobody knows."""
    return ()


class View(NamedTuple):
    """One message for other tools."""

    topic: str
    schema: Schema
    data: bytes
    encoding: str = "protobuf"


class Views:
    """Makes the views of messages, one after the other.

    solids: see `Solids`.
    """

    def __init__(self, solids: Solids) -> None:
        self._solids, self._worlds = solids, dict[str, str]()

    def of(self, message: Message, time_ns: int) -> Iterator[View]:
        """What is to be seen of a message."""
        if isinstance(message, Observation):
            stamp = Timestamp(sec=time_ns // 10**9, nsec=time_ns % 10**9)
            yield from _robot(message, stamp)
            if self._worlds.get(message.robot) != message.world:
                self._worlds[message.robot] = message.world
                yield _world(self._solids(message.world), stamp)
        elif isinstance(message, Action):
            numbers = dict(zip(SHORT_NAMES, message.values, strict=True))
            numbers |= {"action": -1 if message.action is None else message.action}
            numbers |= {name: int(getattr(message, name)) for name in _NUMBERS[len(ACTIONS) + 1 :]}
            data = json.dumps(numbers).encode()
            yield View(f"/{message.robot}/prediction", PREDICTION, data, "json")


def _robot(seen: Observation, stamp: Timestamp) -> Iterator[View]:
    """The image, and where the robot is."""
    image = RawImage(
        timestamp=stamp,
        frame_id=seen.robot,
        width=IMAGE_WIDTH,
        height=IMAGE_HEIGHT,
        encoding="mono8",
        step=IMAGE_WIDTH,
        data=seen.image,
    )
    place, turn = Vector3(x=seen.x_m, y=seen.y_m), _rotation(seen.heading_rad)
    pose = Pose(position=place, orientation=turn)
    there = PoseInFrame(timestamp=stamp, frame_id=WORLD_FRAME, pose=pose)
    moved = FrameTransform(
        timestamp=stamp,
        parent_frame_id=WORLD_FRAME,
        child_frame_id=seen.robot,
        translation=place,
        rotation=turn,
    )
    yield View(f"/{seen.robot}/image", RawImage.get_schema(), image.encode())
    yield View(f"/{seen.robot}/pose", PoseInFrame.get_schema(), there.encode())
    yield View("/tf", FrameTransform.get_schema(), moved.encode())


def _world(solids: Sequence[Box], stamp: Timestamp) -> View:
    """Walls and boxes, in place of those before."""
    cubes = [
        CubePrimitive(
            pose=Pose(
                position=Vector3(x=box.x_m, y=box.y_m, z=box.height_m / 2),
                orientation=_rotation(math.radians(box.heading_deg)),
            ),
            size=Vector3(x=box.length_m, y=box.width_m, z=box.height_m),
            color=Color(**dict(zip("rgb", (part / 255 for part in box.rgb), strict=True)), a=1.0),
        )
        for box in solids
    ]
    world = SceneEntity(timestamp=stamp, frame_id=WORLD_FRAME, id="solids", cubes=cubes)
    return View("/world", SceneUpdate.get_schema(), SceneUpdate(entities=[world]).encode())


def _rotation(heading_rad: float) -> Quaternion:
    return Quaternion(z=math.sin(heading_rad / 2), w=math.cos(heading_rad / 2))
