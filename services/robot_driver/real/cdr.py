"""Turns what a robot tells and is told into ROS 2 messages (`ros2_types.py`) and back.

Whatever comes is checked first. Units and axes are those of ROS, which are ours: SI, x forward, y
left, angles counter-clockwise. Stamps are nanoseconds of the robot's clock; 0: none told. The
reason of a BadMessage comes first and is of a small vocabulary, details follow a colon.
"""

import math
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from services.robot_driver.real.link import Battery
from services.robot_driver.real.picture import RgbImage, decoded, raw
from services.robot_driver.real.ros2_types import (
    BatteryType,
    BumperType,
    CameraType,
    VelocityType,
    decode,
    encode,
    header,
    new,
    stamp_ns_of,
)
from services.robot_driver.robot import Pose, Velocity
from shared.errors import BadMessage

T = TypeVar("T")
BACKUP_LIMIT, BUMP, CLIFF, STALL, WHEEL_DROP, PROXIMITY = range(6)
"""Kinds of hazards of a Create 3."""
CONTACTS = frozenset({BUMP, CLIFF, STALL})
"""Those that end an action: it touches something, stands before a step, or pushes against what its
bumper does not feel."""
LOW_CHARGE = 0.15
"""Part of a full battery, where a robot tells only that, below which it is low."""
FULL = 1.05
"""A charge above this is told in percent; full batteries may tell a little more than 1."""
VOLTS = (1.0, 100.0)
"""A voltage beyond these is none."""
MAX_WAY_M = 1e6
"""Odometry beyond this is nonsense."""


@dataclass(frozen=True)
class Stamped(Generic[T]):
    """A value and the stamp its sender gave it."""

    value: T
    stamp_ns: int
    facts: str = ""
    """What else it tells, for people."""


def decode_odometry(data: bytes) -> Stamped[Pose]:
    """Pose of a nav_msgs/Odometry; heading from its quaternion. Raises BadMessage."""
    message = decode(data, "Odometry")
    if message.child_frame_id.strip("/").rsplit("/", 1)[-1] in ("odom", "map", "world"):
        raise BadMessage(f"frames are swapped: {message.child_frame_id!r:.40} is no robot")
    position, q = message.pose.pose.position, message.pose.pose.orientation
    numbers = (position.x, position.y, q.x, q.y, q.z, q.w)
    if not all(math.isfinite(number) for number in numbers):
        raise BadMessage("not finite")
    if abs(position.x) > MAX_WAY_M or abs(position.y) > MAX_WAY_M:
        raise BadMessage("out of range")
    if not 0.9 < q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w < 1.1:
        raise BadMessage("orientation is no unit quaternion")
    heading = math.atan2(
        2.0 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z
    )
    return Stamped(Pose(position.x, position.y, heading), stamp_ns_of(message))


def decode_camera(data: bytes, kind: CameraType) -> Stamped[RgbImage]:
    """The picture of an Image or CompressedImage: uint8 [h, w, 3], RGB. Raises BadMessage."""
    message = decode(data, kind)
    if kind == "CompressedImage":
        if "compressedDepth" in message.format:
            raise BadMessage("a depth image")
        pixels, form = decoded(message.data.tobytes()), message.format
    else:
        size_px, form = (int(message.width), int(message.height)), message.encoding
        step, big_endian = int(message.step), bool(message.is_bigendian)
        pixels = raw(form, size_px, step, big_endian, message.data)
    facts = f"{pixels.shape[1]}x{pixels.shape[0]} {form:.40}, "
    return Stamped(pixels, stamp_ns_of(message), facts)


def decode_bumper(data: bytes, kind: BumperType) -> Stamped[bool]:
    """Whether there is contact, of a std_msgs/Bool or a Create 3's hazards.

    Raises BadMessage, also for a robot that was lifted and for hazards that nobody knows.
    """
    message = decode(data, kind)
    if kind == "Bool":
        return Stamped(bool(message.data), 0)
    hazards = {int(detection.type) for detection in message.detections}
    if WHEEL_DROP in hazards:
        raise BadMessage("lifted")
    if unknown := hazards - {*CONTACTS, BACKUP_LIMIT, PROXIMITY}:
        raise BadMessage(f"unknown hazard: {min(unknown)}")
    return Stamped(bool(hazards & CONTACTS), stamp_ns_of(message))


def decode_battery(data: bytes, kind: BatteryType, *, percent: bool = False) -> Stamped[Battery]:
    """Charge and voltage, of BatteryState or PowerReadings. Raises BadMessage.

    What means nothing is told as None. percent: the robot tells percent, not a part of one.
    """
    message = decode(data, kind)
    voltage = float(message.voltage)
    sane = math.isfinite(voltage) and VOLTS[0] <= voltage <= VOLTS[1]
    if kind == "PowerReadings":
        battery = Battery(bool(message.battery_low), voltage if sane else None)
    else:
        charge = float(message.percentage)
        part = charge / 100.0 if percent or charge > FULL else min(charge, 1.0)
        told = message.present and 0.0 <= part <= 1.0 and (part > 0.0 or sane)
        battery = Battery(part < LOW_CHARGE if told else None, voltage if sane else None, charge)
    return Stamped(battery, stamp_ns_of(message))


def decode_velocity(data: bytes, kind: VelocityType) -> Stamped[Velocity]:
    """A velocity command. Raises BadMessage, also unless it is finite."""
    message = decode(data, kind)
    twist = message.twist if kind == "TwistStamped" else message
    velocity = Velocity(twist.linear.x, twist.linear.y, twist.angular.z)
    parts = (twist.linear, twist.angular)
    if not all(math.isfinite(n) for part in parts for n in (part.x, part.y, part.z)):
        raise BadMessage("not finite")
    return Stamped(velocity, stamp_ns_of(message) if kind == "TwistStamped" else 0)


def encode_velocity(velocity: Velocity, kind: VelocityType, stamp_ns: int = 0) -> bytes:
    """A velocity command. Raises ValueError unless it is finite."""
    parts = (velocity.forward_m_s, velocity.left_m_s, velocity.turn_rad_s)
    if not all(math.isfinite(part) for part in parts):
        raise ValueError(f"velocity {parts}: expected three finite numbers")
    message = _twist(velocity)
    if kind == "TwistStamped":
        message = new(kind, header(stamp_ns, "base_link"), message)
    return encode(message, kind)


def encode_odometry(pose: Pose, velocity: Velocity, stamp_ns: int) -> bytes:
    """Odometry of a base, covariances zero."""
    half, geometry = pose.heading_rad / 2.0, "geometry_msgs/msg/"
    place = new(f"{geometry}Point", pose.x_m, pose.y_m, 0.0)
    turn = new(f"{geometry}Quaternion", 0.0, 0.0, math.sin(half), math.cos(half))
    covariance, here = np.zeros(36, np.float64), new(f"{geometry}Pose", place, turn)
    parts = (
        new(f"{geometry}PoseWithCovariance", here, covariance),
        new(f"{geometry}TwistWithCovariance", _twist(velocity), covariance),
    )
    return encode(new("Odometry", header(stamp_ns, "odom"), "base_link", *parts), "Odometry")


def encode_image(rgb: RgbImage, stamp_ns: int) -> bytes:
    """An uncompressed picture uint8 [h, w, 3], RGB."""
    height, width = rgb.shape[:2]
    data = np.ascontiguousarray(rgb).reshape(-1)
    head = header(stamp_ns, "camera")
    return encode(new("Image", head, height, width, "rgb8", 0, 3 * width, data), "Image")


def encode_compressed_image(
    data: bytes, stamp_ns: int, *, form: str = "jpeg", frame_id: str = "camera"
) -> bytes:
    """A picture that is compressed already; `form` is the message's `format`."""
    pixels = np.frombuffer(data, np.uint8)
    message = new("CompressedImage", header(stamp_ns, frame_id), form, pixels)
    return encode(message, "CompressedImage")


def encode_bumper(
    pressed: bool, kind: BumperType, stamp_ns: int = 0, *, hazard: int = BUMP
) -> bytes:
    """Contact as std_msgs/Bool, or as a Create 3 tells it: hazards, none when all is clear."""
    if kind == "Bool":
        return encode(new(kind, pressed), kind)
    head = header(stamp_ns, "bump_front_center")
    bump = new("irobot_create_msgs/msg/HazardDetection", head, hazard)
    hazards = [bump] if pressed else []
    return encode(new(kind, header(stamp_ns, "base_link"), hazards), kind)


def encode_battery(battery: Battery, kind: BatteryType, stamp_ns: int) -> bytes:
    """State of a battery, what is unknown as not-a-number."""
    voltage = math.nan if battery.voltage_v is None else battery.voltage_v
    head = header(stamp_ns, "base_link")
    if kind == "PowerReadings":
        return encode(new(kind, head, 0.0, voltage, bool(battery.low)), kind)
    percentage = {True: LOW_CHARGE / 2.0, False: 0.8, None: math.nan}[battery.low]
    unknown, cells = [math.nan] * 5, [np.zeros(0, np.float32)] * 2
    # Discharging, of good health, with lithium ions, present.
    message = new(kind, head, voltage, *unknown, percentage, 2, 1, 2, True, *cells, "", "")
    return encode(message, kind)


def _twist(velocity: Velocity) -> Any:
    v3 = "geometry_msgs/msg/Vector3"
    linear = new(v3, float(velocity.forward_m_s), float(velocity.left_m_s), 0.0)
    return new("Twist", linear, new(v3, 0.0, 0.0, float(velocity.turn_rad_s)))
