"""ROS 2 messages on the wire: known bytes, an independent codec, and bytes that are no messages."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import naive_cdr
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.robot_driver.real import cdr, ros2_types
from services.robot_driver.real.link import Battery
from services.robot_driver.robot import Pose, Velocity
from shared.errors import BadMessage

STAMP_NS = 1_000_000_002
HEADER = "01000000020000000a000000626173655f6c696e6b000000"
numbers = st.floats(allow_nan=False, allow_infinity=False, width=64)
metres = st.floats(-1e5, 1e5)
angles = st.floats(-math.pi, math.pi)
stamps = st.integers(0, 2**31 * 10**9 - 1)
orders = st.booleans()
FAST = settings(deadline=None, max_examples=60, derandomize=True)
texts = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12)


def stamp(ns: int) -> dict[str, int]:
    return {"sec": ns // 10**9, "nanosec": ns % 10**9}


HAZARDS: ros2_types.BumperType = "HazardDetectionVector"


def ordered(raw: bytes, kind: str, little: bool) -> bytes:
    """The same message in little or big endian."""
    return ros2_types.encode(ros2_types.decode(raw, kind), kind, little_endian=little)


def told(message: dict[str, Any]) -> int:
    now = message["header"]["stamp"]
    return int(now["sec"] * 10**9 + now["nanosec"])


# ---------------------------------------------------------------- known bytes


def test_twist_has_the_known_bytes() -> None:
    raw = cdr.encode_velocity(Velocity(0.2, 0.0, -0.5), "Twist")
    assert raw.hex() == "000100009a9999999999c93f" + "00" * 32 + "000000000000e0bf"
    assert len(raw) == 52


def test_bool_has_the_known_bytes() -> None:
    assert cdr.encode_bumper(True, "Bool").hex() == "0001000001"


def test_no_hazards_have_the_known_bytes() -> None:
    raw = cdr.encode_bumper(False, "HazardDetectionVector", STAMP_NS)
    assert raw.hex() == "00010000" + HEADER + "00000000"


def test_a_compressed_image_has_the_known_bytes() -> None:
    raw = cdr.encode_compressed_image(b"\xff\xd8", STAMP_NS, frame_id="base_link")
    assert raw.hex() == "00010000" + HEADER + "050000006a7065670000000002000000ffd8"


def test_odometry_has_the_known_length() -> None:
    message = naive_cdr.plain("Odometry")
    message["header"]["frame_id"] = message["child_frame_id"] = "base_link"
    message["pose"]["pose"]["orientation"]["w"] = 1.0
    raw = naive_cdr.encode(message, "Odometry")
    assert len(raw) == 724
    assert cdr.decode_odometry(raw).value == Pose(0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("kind", "known"),
    [
        ("Twist", "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a"),
        ("TwistStamped", "5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64"),
        ("Odometry", "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"),
        ("Image", "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"),
        ("CompressedImage", "15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a"),
        ("BatteryState", "4bee5dfce981c98faa6828b868307a0a73f992ed0789f374ee96c8f840e69741"),
        ("Bool", "feb91e995ff9ebd09c0cb3d2aed18b11077585839fb5db80193b62d74528f6c9"),
        (
            "HazardDetectionVector",
            "90913822b0a9155a64b12352ba73b2ca9248d73874ebf7700ed277b2dca57edd",
        ),
    ],
)
def test_types_have_the_known_hashes(kind: str, known: str) -> None:
    assert ros2_types.type_hash(kind) == f"RIHS01_{known}"


# ---------------------------------------------------------------- against an independent codec


@FAST
@given(numbers, numbers, numbers, stamps, orders)
def test_velocities_are_read_by_others(
    forward: float, left: float, turn: float, ns: int, little: bool
) -> None:
    velocity = Velocity(forward, left, turn)
    expected = naive_cdr.plain("Twist")
    expected["linear"].update(x=forward, y=left)
    expected["angular"]["z"] = turn
    raw = ordered(cdr.encode_velocity(velocity, "Twist"), "Twist", little)
    assert naive_cdr.decode(raw, "Twist") == expected
    assert cdr.decode_velocity(raw, "Twist") == cdr.Stamped(velocity, 0)
    raw = ordered(cdr.encode_velocity(velocity, "TwistStamped", ns), "TwistStamped", little)
    header = {"stamp": stamp(ns), "frame_id": "base_link"}
    assert naive_cdr.decode(raw, "TwistStamped") == {"header": header, "twist": expected}
    assert cdr.decode_velocity(raw, "TwistStamped") == cdr.Stamped(velocity, ns)


@FAST
@given(metres, metres, angles, stamps, orders)
def test_odometry_is_read_by_others(
    x: float, y: float, heading: float, ns: int, little: bool
) -> None:
    velocity = Velocity(0.1, 0.2, 0.3)
    raw = ordered(cdr.encode_odometry(Pose(x, y, heading), velocity, ns), "Odometry", little)
    message = naive_cdr.decode(raw, "Odometry")
    assert told(message) == ns
    assert message["pose"]["pose"]["position"] == {"x": x, "y": y, "z": 0.0}
    q = message["pose"]["pose"]["orientation"]
    assert math.remainder(2 * math.atan2(q["z"], q["w"]) - heading, 2 * math.pi) == pytest.approx(
        0.0, abs=1e-9
    )
    assert message["twist"]["twist"]["linear"] == {"x": 0.1, "y": 0.2, "z": 0.0}
    assert message["twist"]["twist"]["angular"]["z"] == 0.3
    assert message["pose"]["covariance"] == message["twist"]["covariance"] == [0.0] * 36


@FAST
@given(metres, metres, angles, st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), stamps, texts, orders)
def test_odometry_of_others_is_read(
    x: float, y: float, yaw: float, pitch: float, roll: float, ns: int, frame: str, little: bool
) -> None:
    message = naive_cdr.plain("Odometry")
    message["header"].update(stamp=stamp(ns), frame_id=frame)
    message["child_frame_id"] = frame
    message["pose"]["pose"]["position"].update(x=x, y=y, z=0.1)
    message["pose"]["pose"]["orientation"] = quaternion(roll, pitch, yaw)
    raw = naive_cdr.encode(message, "Odometry", little_endian=little)
    read = cdr.decode_odometry(raw)
    assert (read.value.x_m, read.value.y_m, read.stamp_ns) == (x, y, ns)
    assert math.remainder(read.value.heading_rad - yaw, 2 * math.pi) == pytest.approx(0, abs=1e-6)


def quaternion(roll: float, pitch: float, yaw: float) -> dict[str, float]:
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a / 2), math.sin(a / 2)) for a in (roll, pitch, yaw))
    return {
        "x": sr * cp * cy - cr * sp * sy,
        "y": cr * sp * cy + sr * cp * sy,
        "z": cr * cp * sy - sr * sp * cy,
        "w": cr * cp * cy + sr * sp * sy,
    }


@FAST
@given(
    st.integers(1, 9),
    st.integers(1, 9),
    st.sampled_from(["rgb8", "bgr8", "mono8", "rgba8", "bgra8"]),
    st.integers(0, 5),
    stamps,
    orders,
    st.randoms(use_true_random=False),
)
def test_pictures_are_read_by_others_and_of_others(
    height: int, width: int, encoding: str, padding: int, ns: int, little: bool, random: Any
) -> None:
    rgb = np.frombuffer(random.randbytes(height * width * 3), np.uint8).reshape(height, width, 3)
    if encoding == "mono8":
        rgb = np.repeat(rgb[:, :, :1], 3, axis=2)
    message = naive_cdr.decode(ordered(cdr.encode_image(rgb, ns), "Image", little), "Image")
    assert told(message) == ns
    assert (message["height"], message["width"], message["encoding"]) == (height, width, "rgb8")
    assert (message["step"], bytes(message["data"])) == (3 * width, rgb.tobytes())
    channels = {"mono8": 1, "rgba8": 4, "bgra8": 4}.get(encoding, 3)
    order = {"bgr8": (2, 1, 0), "bgra8": (2, 1, 0), "mono8": (0,)}.get(encoding, (0, 1, 2))
    pixels = np.full((height, width, channels), 255, np.uint8)
    pixels[:, :, order] = rgb[:, :, : len(order)]
    rows = np.pad(pixels.reshape(height, -1), ((0, 0), (0, padding)))
    message.update(encoding=encoding, step=rows.shape[1], data=rows.reshape(-1).tolist())
    again = cdr.decode_camera(naive_cdr.encode(message, "Image", little_endian=little), "Image")
    assert np.array_equal(again.value, rgb)
    assert again.stamp_ns == ns


@FAST
@given(st.binary(max_size=40), texts, stamps, orders)
def test_compressed_pictures_are_read_by_others(
    data: bytes, form: str, ns: int, little: bool
) -> None:
    raw = ordered(cdr.encode_compressed_image(data, ns, form=form), "CompressedImage", little)
    message = naive_cdr.decode(raw, "CompressedImage")
    assert (told(message), message["format"], bytes(message["data"])) == (ns, form, data)


@pytest.mark.parametrize("form", [".jpg", ".png"])
def test_compressed_pictures_of_others_are_read(form: str) -> None:
    rgb = np.zeros((40, 60, 3), np.uint8)
    rgb[:20, :, 0], rgb[20:, :, 2] = 200, 100
    data = cv2.imencode(form, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes()
    message = naive_cdr.plain("CompressedImage")
    message.update(format="rgb8; jpeg compressed bgr8", data=list(data))
    read = cdr.decode_camera(naive_cdr.encode(message, "CompressedImage"), "CompressedImage")
    assert read.value.shape == rgb.shape
    assert np.abs(read.value.astype(int) - rgb).mean() < 4


@FAST
@given(st.booleans(), stamps, orders)
def test_bumpers_are_read_by_others(pressed: bool, ns: int, little: bool) -> None:
    raw = ordered(cdr.encode_bumper(pressed, "Bool"), "Bool", little)
    assert naive_cdr.decode(raw, "Bool") == {"data": pressed}
    raw = ordered(cdr.encode_bumper(pressed, HAZARDS, ns), HAZARDS, little)
    message = naive_cdr.decode(raw, "HazardDetectionVector")
    assert told(message) == ns
    assert [detection["type"] for detection in message["detections"]] == [1] * pressed


@FAST
@given(st.booleans(), st.lists(st.tuples(st.integers(0, 5), texts), max_size=4), stamps, orders)
def test_bumpers_of_others_are_read(
    data: bool, hazards: list[tuple[int, str]], ns: int, little: bool
) -> None:
    raw = naive_cdr.encode({"data": data}, "Bool", little_endian=little)
    assert cdr.decode_bumper(raw, "Bool") == cdr.Stamped(data, 0)
    header = {"stamp": stamp(ns), "frame_id": "base_link"}
    detections = [
        {"header": {"stamp": stamp(ns), "frame_id": frame}, "type": kind} for kind, frame in hazards
    ]
    raw = naive_cdr.encode(
        {"header": header, "detections": detections}, "HazardDetectionVector", little_endian=little
    )
    pressed = any(kind in (1, 2, 3) for kind, _ in hazards)
    if any(kind == 4 for kind, _ in hazards):
        with pytest.raises(BadMessage, match="lifted"):
            cdr.decode_bumper(raw, "HazardDetectionVector")
        return
    assert cdr.decode_bumper(raw, "HazardDetectionVector") == cdr.Stamped(pressed, ns)


@FAST
@given(st.booleans(), st.floats(1.0, 60.0, width=32) | st.none(), stamps, orders)
def test_batteries_are_read_by_others_and_of_others(
    low: bool, voltage: float | None, ns: int, little: bool
) -> None:
    for kind in ("BatteryState", "PowerReadings"):
        raw = ordered(cdr.encode_battery(Battery(low, voltage), kind, ns), kind, little)
        message = naive_cdr.decode(raw, kind)
        assert told(message) == ns
        assert message["voltage"] == voltage or math.isnan(message["voltage"])
        if kind == "PowerReadings":
            assert message["battery_low"] is low
        again = naive_cdr.encode(message, kind, little_endian=little)
        assert cdr.decode_battery(again, kind) == cdr.Stamped(Battery(low, voltage), ns)


@pytest.mark.parametrize(
    ("voltage", "percentage", "present", "percent", "low"),
    [
        (math.nan, math.nan, True, False, None),
        (0.0, 0.0, True, False, None),
        (14.0, 0.0, True, False, True),
        (14.0, 0.8, True, False, False),
        (14.0, 0.8, False, False, None),
        (14.0, 0.8, True, True, True),
        (math.nan, 0.1, True, False, True),
        (14.0, 12.0, True, False, True),
        (14.0, 100.0, True, False, False),
        (14.0, 1.01, True, False, False),
        (14.0, 101.0, True, False, None),
        (14.0, -1.0, True, False, None),
        (math.inf, 0.5, True, False, False),
    ],
)
def test_a_battery_is_low_or_good_only_where_the_robot_tells(
    voltage: float, percentage: float, present: bool, percent: bool, low: bool | None
) -> None:
    message = naive_cdr.plain("BatteryState")
    message.update(voltage=voltage, percentage=percentage, present=present)
    raw = naive_cdr.encode(message, "BatteryState")
    read = cdr.decode_battery(raw, "BatteryState", percent=percent).value
    assert read == Battery(low, voltage if 1.0 < voltage < 100.0 else None)


SAMPLES = {
    name: (kind, bytes.fromhex(data))
    for name, kind, data in (
        line.split() for line in (Path(__file__).parent / "samples.txt").read_text().splitlines()
    )
}
"""Messages shaped like those that users posted."""


@pytest.mark.parametrize(
    ("name", "low", "voltage_v"),
    [
        ("battery-percentage-is-12-of-100", True, 11.2),
        ("battery-all-zero-before-first-change", None, None),
    ],
)
def test_samples_of_batteries(name: str, low: bool | None, voltage_v: float | None) -> None:
    read = cdr.decode_battery(SAMPLES[name][1], "BatteryState").value
    assert (read.low, read.voltage_v) == (low, pytest.approx(voltage_v))


@pytest.mark.parametrize(
    ("hazard", "pressed"), [("none", False), ("backup-limit", False), ("bump", True)]
)
def test_samples_of_hazards(hazard: str, pressed: bool) -> None:
    kind, raw = SAMPLES[f"hazards-zero-stamp-{hazard}"]
    assert cdr.decode_bumper(raw, kind) == cdr.Stamped(pressed, 0)  # type: ignore[arg-type]


def test_a_lifted_robot_is_told_of_and_an_unknown_hazard_is_no_all_clear() -> None:
    kind, raw = SAMPLES["hazards-zero-stamp-wheel-drop"]
    with pytest.raises(BadMessage, match="lifted"):
        cdr.decode_bumper(raw, kind)  # type: ignore[arg-type]
    with pytest.raises(BadMessage, match="unknown hazard"):
        cdr.decode_bumper(raw[:-1] + b"\x09", kind)  # type: ignore[arg-type]


def test_samples_of_pictures() -> None:
    plain = np.arange(144, dtype=np.uint8).reshape(6, 8, 3)
    raw = SAMPLES["image-8UC3-6x8"][1]
    assert np.array_equal(cdr.decode_camera(raw, "Image").value, plain[:, :, ::-1])
    raw = SAMPLES["image-yuv422_yuy2-6x8"][1]
    luma = np.arange(96, dtype=np.uint8).reshape(6, 8, 2)[:, :, :1]
    assert np.array_equal(cdr.decode_camera(raw, "Image").value, np.repeat(luma, 3, axis=2))
    with pytest.raises(BadMessage, match=r"unknown encoding: '16UC1', accepted: mono8, .*nv12"):
        cdr.decode_camera(SAMPLES["image-16UC1-6x8"][1], "Image")


@pytest.mark.parametrize(
    ("encoding", "first", "changes"),
    [
        ("8UC1", 0, {"step": 6, "data": list(range(24))}),
        ("mono16", 1, {"step": 12, "data": list(range(48))}),
        ("mono16", 0, {"step": 12, "data": list(range(48)), "is_bigendian": 1}),
        ("yuv422", 1, {"step": 12, "data": list(range(48))}),
        ("yuyv", 0, {"step": 13, "data": list(range(52))}),
        ("nv12", 0, {"step": 6, "data": list(range(36))}),
    ],
)
def test_of_pictures_in_other_encodings_the_brightness_is_read(
    encoding: str, first: int, changes: dict[str, Any]
) -> None:
    picture = cdr.decode_camera(image(encoding=encoding, **changes), "Image").value
    pixel = 1 if encoding in ("8UC1", "nv12") else 2
    row = [first + pixel * column for column in range(6)]
    expected = [[at + changes["step"] * line for at in row] for line in range(4)]
    assert picture[:, :, 0].tolist() == picture[:, :, 2].tolist() == expected


# ---------------------------------------------------------------- bytes that are no messages

DECODERS: dict[str, Callable[[bytes], object]] = {
    "Twist": lambda raw: cdr.decode_velocity(raw, "Twist"),
    "TwistStamped": lambda raw: cdr.decode_velocity(raw, "TwistStamped"),
    "Odometry": cdr.decode_odometry,
    "Image": lambda raw: cdr.decode_camera(raw, "Image"),
    "CompressedImage": lambda raw: cdr.decode_camera(raw, "CompressedImage"),
    "Bool": lambda raw: cdr.decode_bumper(raw, "Bool"),
    "HazardDetectionVector": lambda raw: cdr.decode_bumper(raw, "HazardDetectionVector"),
    "BatteryState": lambda raw: cdr.decode_battery(raw, "BatteryState"),
    "PowerReadings": lambda raw: cdr.decode_battery(raw, "PowerReadings"),
}


def sound(kind: str) -> bytes:
    if kind in ("Twist", "TwistStamped"):
        return cdr.encode_velocity(Velocity(0.1, 0.0, 0.2), kind, STAMP_NS)  # type: ignore[arg-type]
    if kind == "Odometry":
        return cdr.encode_odometry(Pose(1.0, 2.0, 0.5), Velocity(0.1, 0.0, 0.0), STAMP_NS)
    if kind == "Image":
        return cdr.encode_image(np.zeros((5, 7, 3), np.uint8), STAMP_NS)
    if kind == "CompressedImage":
        data = cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes()
        return cdr.encode_compressed_image(data, STAMP_NS)
    if kind in ("Bool", "HazardDetectionVector"):
        return cdr.encode_bumper(True, kind, STAMP_NS)  # type: ignore[arg-type]
    return cdr.encode_battery(Battery(False, 15.0), kind, STAMP_NS)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", sorted(DECODERS))
def test_every_shorter_payload_is_refused(kind: str) -> None:
    raw = sound(kind)
    DECODERS[kind](raw)
    for length in range(len(raw)):
        with pytest.raises(BadMessage):
            DECODERS[kind](raw[:length])


@pytest.mark.parametrize("kind", sorted(DECODERS))
def test_three_bytes_of_padding_pass_and_more_do_not(kind: str) -> None:
    raw = sound(kind)
    expected = repr(DECODERS[kind](raw))
    for count in (1, 2, 3):
        assert repr(DECODERS[kind](raw + bytes(count))) == expected
    for count in (4, 8, 100):
        with pytest.raises(BadMessage):
            DECODERS[kind](raw + bytes(count))


@pytest.mark.parametrize("kind", sorted(DECODERS))
@pytest.mark.parametrize("head", [b"\0\2", b"\0\7", b"\0\x09", b"\1\0", b"\xff\xff"])
def test_other_encapsulations_are_refused(kind: str, head: bytes) -> None:
    with pytest.raises(BadMessage, match="unknown encapsulation"):
        DECODERS[kind](head + sound(kind)[2:])


@pytest.mark.parametrize("kind", sorted(DECODERS))
def test_empty_and_huge_payloads_are_refused_unread(kind: str) -> None:
    with pytest.raises(BadMessage, match=r"^empty"):
        DECODERS[kind](b"")
    with pytest.raises(BadMessage, match=r"^too long"):
        DECODERS[kind](sound(kind) + bytes(ros2_types.MAX_BYTES[kind]))


@pytest.mark.parametrize("kind", sorted(DECODERS))
@settings(deadline=None, max_examples=200, derandomize=True)
@given(data=st.data())
def test_whatever_comes_is_a_message_or_refused(kind: str, data: st.DataObject) -> None:
    raw = bytearray(sound(kind))
    for _ in range(data.draw(st.integers(1, 6))):
        raw[data.draw(st.integers(4, len(raw) - 1))] = data.draw(st.integers(0, 255))
    with suppress(BadMessage):
        DECODERS[kind](bytes(raw))


@FAST
@given(st.binary(max_size=200), st.sampled_from(sorted(DECODERS)))
def test_noise_is_a_message_or_refused(noise: bytes, kind: str) -> None:
    with suppress(BadMessage):
        DECODERS[kind](b"\0\1\0\0" + noise)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_numbers_that_are_not_finite_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        cdr.encode_velocity(Velocity(0.0, bad, 0.0), "Twist")
    for at in range(6):
        raw = bytearray(sound("Twist"))
        struct.pack_into("<d", raw, 4 + 8 * at, bad)
        with pytest.raises(BadMessage, match="not finite"):
            cdr.decode_velocity(bytes(raw), "Twist")
    for pose in (Pose(bad, 0.0, 0.0), Pose(0.0, bad, 0.0)):
        with pytest.raises(BadMessage, match="not finite"):
            cdr.decode_odometry(cdr.encode_odometry(pose, Velocity(0, 0, 0), 1))
    message = naive_cdr.plain("Odometry")
    message["pose"]["pose"]["orientation"]["w"] = bad
    with pytest.raises(BadMessage, match="not finite"):
        cdr.decode_odometry(naive_cdr.encode(message, "Odometry"))


def test_odometry_whose_frames_are_swapped_is_refused() -> None:
    message = naive_cdr.plain("Odometry")
    message["pose"]["pose"]["orientation"]["w"] = 1.0
    message["pose"]["covariance"] = [math.nan] * 36
    for child, swapped in (("base_link", False), ("bot1/odom", True), ("/map", True)):
        message["child_frame_id"] = child
        raw = naive_cdr.encode(message, "Odometry")
        if swapped:
            with pytest.raises(BadMessage, match="frames are swapped"):
                cdr.decode_odometry(raw)
        else:
            assert cdr.decode_odometry(raw).value == Pose(0.0, 0.0, 0.0)


def test_an_orientation_that_is_none_is_refused() -> None:
    with pytest.raises(BadMessage, match="quaternion"):
        cdr.decode_odometry(naive_cdr.encode(naive_cdr.plain("Odometry"), "Odometry"))


def image(**changes: object) -> bytes:
    message = naive_cdr.plain("Image")
    message.update(height=4, width=6, encoding="rgb8", step=18, data=[7] * 72)
    message.update(changes)
    return naive_cdr.encode(message, "Image")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"step": 17, "data": [7] * 68}, "rows do not fit"),
        ({"data": [7] * 71}, "rows do not fit"),
        ({"height": 5}, "rows do not fit"),
        ({"width": 0}, "unusable size"),
        ({"height": 2**31}, "unusable size"),
        ({"encoding": "16UC1"}, "unknown encoding"),
        ({"encoding": "bayer_rggb8"}, "unknown encoding"),
    ],
)
def test_pictures_whose_sizes_do_not_fit_are_refused(
    changes: dict[str, object], reason: str
) -> None:
    assert cdr.decode_camera(image(), "Image").value.shape == (4, 6, 3)
    with pytest.raises(BadMessage, match=reason):
        cdr.decode_camera(image(**changes), "Image")


def test_depth_and_broken_off_pictures_are_refused() -> None:
    data = cv2.imencode(".jpg", np.zeros((64, 64, 3), np.uint8))[1].tobytes()
    for form, content, reason in (
        ("32FC1; compressedDepth", data, "depth"),
        ("jpeg", data[: len(data) // 2], "cut off"),
        ("jpeg", b"GIF89a", "neither"),
        ("jpeg", b"", "neither"),
    ):
        raw = cdr.encode_compressed_image(content, STAMP_NS, form=form)
        with pytest.raises(BadMessage, match=reason):
            cdr.decode_camera(raw, "CompressedImage")
