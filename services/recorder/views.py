"""What other tools show of a run: images, poses, worlds and predictions in Foxglove's schemas.

A recording has them beside the messages of the protocol from which they are made. Playback does not
read them. An image is the same bytes in both, so that compression stores it once.
"""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from foxglove import Schema
from foxglove import messages as fox

from shared.facts import IMAGE_HEIGHT, IMAGE_WIDTH, SHORT_NAMES
from shared.messages import Action, Box, Message, Observation

Solids = Callable[[str], Sequence[Box]]
"""Walls and boxes of a world, by its name."""
WORLD = "world"
_NUMBERS = dict.fromkeys((*SHORT_NAMES, "action", "weights_version", "episode"))
_FIELDS = {"type": "object", "properties": {name: {"type": "number"} for name in _NUMBERS}}
PREDICTION = Schema(
    name="corridor.Prediction", encoding="jsonschema", data=json.dumps(_FIELDS).encode()
)


class View(NamedTuple):
    """One message for other tools."""

    topic: str
    schema: Schema
    data: bytes
    encoding: str = "protobuf"


class Views:
    """Makes the views of messages, one after the other. solids: see `Solids`."""

    def __init__(self, solids: Solids) -> None:
        self._solids, self._worlds = solids, dict[str, str]()

    def of(self, message: Message, time_ns: int) -> Iterator[View]:
        """What is to be seen of a message."""
        if isinstance(message, Observation):
            stamp = fox.Timestamp(sec=time_ns // 10**9, nsec=time_ns % 10**9)
            yield from _robot(message, stamp)
            if self._worlds.get(message.robot) != message.world:
                self._worlds[message.robot] = message.world
                yield _world(self._solids(message.world), stamp)
        elif isinstance(message, Action):
            numbers: dict[str, float]
            numbers = {name: int(getattr(message, name, 0) or 0) for name in _NUMBERS}
            numbers |= dict(zip(SHORT_NAMES, message.values, strict=True))
            numbers["action"] = -1 if message.action is None else message.action
            data = json.dumps(numbers).encode()
            yield View(f"/{message.robot}/prediction", PREDICTION, data, "json")


def _robot(seen: Observation, stamp: fox.Timestamp) -> Iterator[View]:
    """The image, and where the robot is."""
    image = fox.RawImage(
        timestamp=stamp, frame_id=seen.robot, width=IMAGE_WIDTH, height=IMAGE_HEIGHT,
        encoding="mono8", step=IMAGE_WIDTH, data=seen.image,
    )  # fmt: skip
    pose = _pose(seen.x_m, seen.y_m, 0.0, seen.heading_rad)
    there = fox.PoseInFrame(timestamp=stamp, frame_id=WORLD, pose=pose)
    moved = fox.FrameTransform(
        timestamp=stamp, parent_frame_id=WORLD, child_frame_id=seen.robot,
        translation=fox.Vector3(x=seen.x_m, y=seen.y_m), rotation=_rotation(seen.heading_rad),
    )  # fmt: skip
    yield View(f"/{seen.robot}/image", image.get_schema(), image.encode())
    yield View(f"/{seen.robot}/pose", there.get_schema(), there.encode())
    yield View("/tf", moved.get_schema(), moved.encode())


def _world(solids: Sequence[Box], stamp: fox.Timestamp) -> View:
    """Walls and boxes, in place of those before."""
    cubes = [
        fox.CubePrimitive(
            pose=_pose(box.x_m, box.y_m, box.height_m / 2, math.radians(box.heading_deg)),
            size=fox.Vector3(x=box.length_m, y=box.width_m, z=box.height_m),
            color=fox.Color(r=box.rgb[0] / 255, g=box.rgb[1] / 255, b=box.rgb[2] / 255, a=1.0),
        )
        for box in solids
    ]
    update = fox.SceneUpdate(
        entities=[fox.SceneEntity(timestamp=stamp, frame_id=WORLD, id="solids", cubes=cubes)]
    )
    return View("/world", update.get_schema(), update.encode())


def _pose(x_m: float, y_m: float, z_m: float, heading_rad: float) -> fox.Pose:
    place = fox.Vector3(x=x_m, y=y_m, z=z_m)
    return fox.Pose(position=place, orientation=_rotation(heading_rad))


def _rotation(heading_rad: float) -> fox.Quaternion:
    return fox.Quaternion(z=math.sin(heading_rad / 2), w=math.cos(heading_rad / 2))
