"""How topics of a ROS 2 robot are called on Zenoh, and what the network says of them (pure).

zenoh-bridge-ros2dds names topics alone, and tells types by liveliness tokens (`liveliness_mgt.rs`);
rmw_zenoh names topic, type and its hash, and adds an attachment to every sample (its
`docs/design.md` and `attachment_helpers.cpp`).
"""

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

Direction = Literal["publishes", "listens"]
TOKEN_KEYS = ("@/*/@ros2_lv/**", "@ros2_lv/**")
"""Where both ways announce who publishes and who listens; a chunk with @ needs to be spelt out."""
NO_HASH = "TypeHashNotSupported"
"""What ROS Humble, which has no hashes of types, has instead."""
ANY_HASH = "*"
VELOCITY_TYPES = {
    "Twist": "geometry_msgs/msg/Twist",
    "TwistStamped": "geometry_msgs/msg/TwistStamped",
}
_DIRECTIONS: dict[str, Direction] = {"MP": "publishes", "MS": "listens"}
_ATTACHMENT = struct.Struct("<qqB16s")
ATTACHMENT_BYTES = _ATTACHMENT.size
GID_BYTES = 16
_INT64 = 2**63


@dataclass(frozen=True)
class Endpoint:
    """Somebody on the robot's network who publishes or listens."""

    direction: Direction
    topic: str
    """Name without a leading slash, with its namespace."""
    type_name: str
    """Full name of its type, such as `geometry_msgs/msg/Twist`."""


@dataclass(frozen=True)
class Attachment:
    """What rmw_zenoh adds to every sample."""

    sequence: int
    """1 for the first sample of a publisher, growing."""
    stamp_ns: int
    gid: bytes
    """16 bytes, of the publisher."""


def full_topic(namespace: str, topic: str) -> str:
    """A topic with its namespace, without leading slashes."""
    return f"{namespace.strip('/')}/{topic.lstrip('/')}".lstrip("/")


def short(type_name: str) -> str:
    """`Twist` of `geometry_msgs/msg/Twist`."""
    return type_name.rsplit("/", 1)[-1]


def rmw_type(type_name: str) -> str:
    """`geometry_msgs::msg::dds_::Twist_` of `geometry_msgs/msg/Twist`."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def rmw_key(domain: int, topic: str, type_name: str, type_hash: str) -> str:
    """Key of a topic on rmw_zenoh. With `ANY_HASH` it matches every hash."""
    return f"{domain}/{topic}/{rmw_type(type_name)}/{type_hash}"


def packed(attachment: Attachment) -> bytes:
    """The 33 bytes of an attachment. Raises ValueError for numbers that do not fit."""
    try:
        return _ATTACHMENT.pack(attachment.sequence, attachment.stamp_ns, GID_BYTES, attachment.gid)
    except struct.error as error:
        raise ValueError(f"attachment: {error}") from error


def unpacked(data: bytes) -> Attachment | None:
    """The attachment in these bytes; None when they are none."""
    if len(data) != ATTACHMENT_BYTES:
        return None
    sequence, stamp_ns, length, gid = _ATTACHMENT.unpack(data)
    return Attachment(sequence, stamp_ns, gid) if length == GID_BYTES else None


def bridge_token(zid: str, endpoint: Endpoint) -> str:
    """The token by which the bridge tells of an endpoint (default quality of service)."""
    letters = "MP" if endpoint.direction == "publishes" else "MS"
    topic, type_name = endpoint.topic.replace("/", "§"), endpoint.type_name.replace("/", "§")
    return f"@/{zid}/@ros2_lv/{letters}/{topic}/{type_name}/:::"


def rmw_token(
    domain: int, zid: str, number: int, endpoint: Endpoint, type_hash: str, node: str
) -> str:
    """The token by which a node on rmw_zenoh tells of an endpoint (reliable, depth 10)."""
    letters = "MP" if endpoint.direction == "publishes" else "MS"
    topic = "%" + endpoint.topic.replace("/", "%")
    return (
        f"@ros2_lv/{domain}/{zid}/0/{number}/{letters}/%/%/{node}/{topic}/"
        f"{rmw_type(endpoint.type_name)}/{type_hash}/::,10:,:,:,,"
    )


def parsed_token(key: str, domain: int) -> Endpoint | None:
    """What a token tells; None for other tokens, those of another domain included."""
    chunks = key.split("/")
    if len(chunks) == 7 and chunks[0] == "@" and chunks[2] == "@ros2_lv":
        return _bridged(*chunks[3:6])
    if len(chunks) == 6 and chunks[0] == "@ros2_lv":
        return _bridged(*chunks[2:5])
    if len(chunks) == 13 and chunks[0] == "@ros2_lv" and chunks[1] == str(domain):
        direction = _DIRECTIONS.get(chunks[5])
        topic, type_name = chunks[9].replace("%", "/").lstrip("/"), _ros_type(chunks[10])
        return Endpoint(direction, topic, type_name) if direction else None
    return None


def types_on(endpoints: Iterable[Endpoint], direction: Direction, topic: str) -> frozenset[str]:
    """Types of those who publish or listen on a topic; empty when nobody is known."""
    return frozenset(e.type_name for e in endpoints if (e.direction, e.topic) == (direction, topic))


def velocity_type(
    configured: str,
    topic: str,
    listening: frozenset[str],
    matching: Mapping[str, bool],
    transport: Literal["bridge", "rmw-zenoh"],
) -> tuple[str, str]:
    """Which type of velocity to send, and why none may be sent now; each empty if there is none.

    configured: `Twist`, `TwistStamped` or `auto`. listening: full names of the types that tokens
    tell of. matching: by short type, whether Zenoh knows a subscriber of our key.
    """
    bridge = transport == "bridge"
    known = [name for name, full in VELOCITY_TYPES.items() if full in listening]
    told = " and ".join(sorted(short(name) for name in listening))
    if configured != "auto":
        # On the bridge's one key everybody gets what is sent: one of another type is too many.
        alone = listening <= {VELOCITY_TYPES[configured]} or not bridge
        if listening and (configured not in known or not alone):
            return "", f"robot listens for {told} on {topic}, configured {configured}"
        known = [configured]
    elif listening:
        if len(known) != 1 or (transport == "bridge" and len(listening) > 1):
            return "", f"robot listens for {told} on {topic}, expected either Twist or TwistStamped"
    else:
        known = [name for name, matches in matching.items() if matches]
        if len(known) > 1 or (known and bridge):
            return "", (
                f"the network does not tell what the robot listens for on {topic}: "
                f"set robot.ros2.velocity_type"
            )
    chosen = known[0] if known else ""
    if matching.get(chosen):
        return chosen, ""
    if listening and not bridge:
        return chosen, (
            f"robot listens for {chosen} on {topic} with another hash of the type: "
            f"check robot.ros2.distribution"
        )
    return chosen, f"nothing on the robot listens on {topic}"


def _bridged(letters: str, topic: str, type_name: str) -> Endpoint | None:
    direction = _DIRECTIONS.get(letters)
    if direction is None:
        return None
    return Endpoint(direction, topic.replace("§", "/").lstrip("/"), _ros_type(type_name))


def _ros_type(text: str) -> str:
    """The ROS name of a type, told in either form."""
    parts = text.replace("§", "/").replace("::", "/").split("/")
    if len(parts) == 4 and parts[2] == "dds_":
        return f"{parts[0]}/{parts[1]}/{parts[3].removesuffix('_')}"
    return "/".join(parts)
