"""CDR read and written field by field from tables: slow, plain, and nobody else's code.

Numbers are aligned to their own size, counted from behind the four bytes of the encapsulation.
"""

from __future__ import annotations

import re
import struct
from typing import Any

FIELDS = {
    "Time": "int32 sec, uint32 nanosec",
    "Header": "Time stamp, string frame_id",
    "Bool": "bool data",
    "Vector3": "float64 x, float64 y, float64 z",
    "Twist": "Vector3 linear, Vector3 angular",
    "TwistStamped": "Header header, Twist twist",
    "Quaternion": "float64 x, float64 y, float64 z, float64 w",
    "Pose": "Vector3 position, Quaternion orientation",
    "PoseWithCovariance": "Pose pose, float64[36] covariance",
    "TwistWithCovariance": "Twist twist, float64[36] covariance",
    "Odometry": (
        "Header header, string child_frame_id, PoseWithCovariance pose, TwistWithCovariance twist"
    ),
    "Image": (
        "Header header, uint32 height, uint32 width, string encoding, uint8 is_bigendian, "
        "uint32 step, uint8[] data"
    ),
    "CompressedImage": "Header header, string format, uint8[] data",
    "HazardDetection": "Header header, uint8 type",
    "HazardDetectionVector": "Header header, HazardDetection[] detections",
    "PowerReadings": "Header header, float32 current, float32 voltage, bool battery_low",
    "BatteryState": (
        "Header header, float32 voltage, float32 temperature, float32 current, float32 charge, "
        "float32 capacity, float32 design_capacity, float32 percentage, "
        "uint8 power_supply_status, uint8 power_supply_health, uint8 power_supply_technology, "
        "bool present, float32[] cell_voltage, float32[] cell_temperature, string location, "
        "string serial_number"
    ),
}
NUMBERS = {
    "bool": "?", "uint8": "B", "int32": "i", "uint32": "I", "float32": "f", "float64": "d"
}  # fmt: skip


class Reader:
    def __init__(self, raw: bytes) -> None:
        assert raw[:2] in (b"\0\0", b"\0\1")
        self.order = "<" if raw[1] else ">"
        self.body, self.at = raw[4:], 0

    def value(self, kind: str) -> Any:
        if array := re.fullmatch(r"(\w+)\[(\d*)\]", kind):
            count = int(array[2]) if array[2] else self.value("uint32")
            return [self.value(array[1]) for _ in range(count)]
        if kind == "string":
            length = self.value("uint32")
            text, self.at = self.body[self.at : self.at + length], self.at + length
            assert text.endswith(b"\0")
            return text[:-1].decode()
        if kind in NUMBERS:
            number = struct.Struct(self.order + NUMBERS[kind])
            self.at += -self.at % number.size
            (value,) = number.unpack_from(self.body, self.at)
            self.at += number.size
            return value
        return {name: self.value(of) for of, name in fields(kind)}


class Writer:
    def __init__(self, *, little_endian: bool) -> None:
        self.order, self.body = "<" if little_endian else ">", bytearray()

    def value(self, kind: str, value: Any) -> None:
        if array := re.fullmatch(r"(\w+)\[(\d*)\]", kind):
            if not array[2]:
                self.value("uint32", len(value))
            for item in value:
                self.value(array[1], item)
        elif kind == "string":
            self.value("uint32", len(value.encode()) + 1)
            self.body += value.encode() + b"\0"
        elif kind in NUMBERS:
            number = struct.Struct(self.order + NUMBERS[kind])
            self.body += bytes(-len(self.body) % number.size) + number.pack(value)
        else:
            for of, name in fields(kind):
                self.value(of, value[name])


def fields(kind: str) -> list[tuple[str, str]]:
    pairs = (field.split() for field in FIELDS[kind].split(", "))
    return [(of, name) for of, name in pairs]


def decode(raw: bytes, kind: str) -> dict[str, Any]:
    reader = Reader(raw)
    message = reader.value(kind)
    assert reader.at == len(reader.body), "bytes are left"
    return dict(message)


def encode(message: dict[str, Any], kind: str, *, little_endian: bool = True) -> bytes:
    writer = Writer(little_endian=little_endian)
    writer.value(kind, message)
    return bytes([0, little_endian, 0, 0]) + bytes(writer.body)


def plain(kind: str) -> Any:
    """The plainest value of a type, to be filled in."""
    if array := re.fullmatch(r"(\w+)\[(\d*)\]", kind):
        return [plain(array[1]) for _ in range(int(array[2] or 0))]
    if kind == "string":
        return ""
    if kind in NUMBERS:
        return {"bool": False, "float32": 0.0, "float64": 0.0}.get(kind, 0)
    return {name: plain(of) for of, name in fields(kind)}
