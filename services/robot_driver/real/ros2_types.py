"""The ROS 2 types that a robot is driven with, and their CDR. Only this imports rosbags."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, Literal

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from services.robot_driver.real import ros2_names
from shared.errors import BadMessage

if TYPE_CHECKING:
    from shared.config import Ros2Config

VelocityType = Literal["Twist", "TwistStamped"]
CameraType = Literal["Image", "CompressedImage"]
BumperType = Literal["Bool", "HazardDetectionVector"]
BatteryType = Literal["BatteryState", "PowerReadings"]

KIB = 1024
_TYPES = {
    "Twist": ("geometry_msgs/msg/Twist", 4 * KIB),
    "TwistStamped": ("geometry_msgs/msg/TwistStamped", 4 * KIB),
    "Odometry": ("nav_msgs/msg/Odometry", 16 * KIB),
    "Image": ("sensor_msgs/msg/Image", 3 * 2048 * 2048 + 4 * KIB),
    "CompressedImage": ("sensor_msgs/msg/CompressedImage", 4 * KIB * KIB),
    "Bool": ("std_msgs/msg/Bool", 64),
    "HazardDetectionVector": ("irobot_create_msgs/msg/HazardDetectionVector", 64 * KIB),
    "BatteryState": ("sensor_msgs/msg/BatteryState", 16 * KIB),
    "PowerReadings": ("rto_msgs/msg/PowerReadings", 4 * KIB),
}
FULL_NAMES = {short: name for short, (name, _) in _TYPES.items()}
"""Full names of the types that a robot is driven with, by short name."""
MAX_BYTES = {short: most for short, (_, most) in _TYPES.items()}
"""Longest payload of each type; longer ones are refused unread."""

# Fields of the types that do not come with ROS itself.
_CUSTOM = {
    "irobot_create_msgs/msg/HazardDetection": "std_msgs/Header header\nuint8 type\n",
    "irobot_create_msgs/msg/HazardDetectionVector": (
        "std_msgs/Header header\nirobot_create_msgs/HazardDetection[] detections\n"
    ),
    "rto_msgs/msg/PowerReadings": (
        "std_msgs/Header header\nfloat32 current\nfloat32 voltage\nbool battery_low\n"
    ),
}

_ENCAPSULATIONS = (b"\x00\x00", b"\x00\x01")
"""CDR, big and little endian; what follows are options that mean nothing."""
_S_NS = 1_000_000_000


def type_hash(kind: str, distribution: str = "jazzy") -> str:
    """`RIHS01_...` of a type by its short name, as rmw_zenoh has it in its keys."""
    if distribution == "humble":
        return ros2_names.NO_HASH
    return str(_store().hash_rihs01(FULL_NAMES[kind]))


def key_of(ros: Ros2Config, topic: str, kind: str, hashed: str = "") -> str:
    """Key of a topic, its namespace included, by the short name of its type; hashed: its hash."""
    if ros.transport == "bridge":
        return topic
    hashed = hashed or type_hash(kind, ros.distribution)
    return ros2_names.rmw_key(ros.domain, topic, FULL_NAMES[kind], hashed)


@functools.cache
def _store() -> Any:
    """All types, those of ROS and ours. Humble's and Jazzy's are equal here."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in _CUSTOM.items():
        store.register(get_types_from_msg(text, name))
    return store


def new(name: str, *fields: Any) -> Any:
    """A message of a type by its short or full name, its fields in the order of the wire."""
    return _store().types[FULL_NAMES.get(name, name)](*fields)


def encode(message: Any, kind: str, *, little_endian: bool = True) -> bytes:
    """CDR of a message; kind: short name of its type."""
    return bytes(_store().serialize_cdr(message, FULL_NAMES[kind], little_endian=little_endian))


def decode(raw: bytes, kind: str) -> Any:
    """The message in CDR bytes; kind: short name of its type. Raises BadMessage unless all fits."""
    if not raw:
        raise BadMessage("empty")
    if len(raw) > MAX_BYTES[kind]:
        raise BadMessage(f"too long: {len(raw)} bytes, at most {MAX_BYTES[kind]}")
    if len(raw) < 4 or raw[:2] not in _ENCAPSULATIONS:
        raise BadMessage(f"unknown encapsulation: {raw[:4].hex()}")
    try:
        return _store().deserialize_cdr(raw, FULL_NAMES[kind])
    except SerdeError as error:
        raise BadMessage(f"truncated or of another type: {kind}: {error}") from error


def header(stamp_ns: int, frame_id: str) -> Any:
    """A message's header."""
    seconds, nanoseconds = divmod(stamp_ns, _S_NS)
    stamp = new("builtin_interfaces/msg/Time", seconds, nanoseconds)
    return new("std_msgs/msg/Header", stamp, frame_id)


def stamp_ns_of(message: Any) -> int:
    """The stamp in a message's header."""
    stamp = message.header.stamp
    return int(stamp.sec) * _S_NS + int(stamp.nanosec)
