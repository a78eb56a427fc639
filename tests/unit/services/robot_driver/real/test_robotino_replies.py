"""What a Robotino's server may answer, and what is made of it."""

from __future__ import annotations

import json
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.robot_driver.real import robotino_replies as replies
from services.robot_driver.real.link import Battery
from services.robot_driver.robot import Pose
from shared.errors import BadMessage

FAST = settings(deadline=None, max_examples=150, derandomize=True)


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        (b"[0, 0, 0, 0, 0, 0, 27501]", (Pose(0.0, 0.0, 0.0), 27501)),
        (b"[1.5,-2,0.5,0.1,0,0,3.0]", (Pose(1.5, -2.0, 0.5), 3)),
        (b" [1,2,7,0,0,0,1]\n", (Pose(1.0, 2.0, 7.0 - 2 * np.pi), 1)),
    ],
)
def test_odometry(body: bytes, expected: tuple[Pose, int]) -> None:
    pose, sequence = replies.odometry(body)
    assert sequence == expected[1]
    want = expected[0]
    assert (pose.x_m, pose.y_m, pose.heading_rad) == pytest.approx(
        (want.x_m, want.y_m, want.heading_rad)
    )


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        (b"", "empty"),
        (b"  \n", "empty"),
        (b"{", "not as expected"),
        (b"\xff\xfe", "not as expected"),
        (b"[" * 100_000, "not as expected"),
        (b"{}", "not as expected"),
        (b"[1,2,3]", "not as expected"),
        (b"[1,2,3,4,5,6,7,8]", "not as expected"),
        (b"[1,2,true,0,0,0,1]", "not as expected"),
        (b'[1,2,"3",0,0,0,1]', "not as expected"),
        (b"[1,2,null,0,0,0,1]", "not as expected"),
        (b"[1,2,NaN,0,0,0,1]", "not as expected"),
        (b"[1,2,3,0,0,Infinity,1]", "not as expected"),
        (b"[1,2,3,0,0,0,true]", "not as expected"),
        (b"[1e9,2,3,0,0,0,1]", "not as expected"),
        (b"[1" + b"0" * 400 + b",2,3,0,0,0,1]", "not as expected"),
    ],
)
def test_odometry_that_cannot_be_used(body: bytes, reason: str) -> None:
    with pytest.raises(BadMessage, match=f"^{reason}"):
        replies.odometry(body)


def test_the_bumper_is_pressed_or_not_or_unknown() -> None:
    assert replies.bumper(b'{"value": true}')
    assert not replies.bumper(b'{"value":false}')
    for body in (b"", b"{}", b"[]", b'{"value": 0}', b'{"value": null}', b'{"value": "false"}'):
        with pytest.raises(BadMessage):
            replies.bumper(body)


def test_the_battery_is_low_or_not_and_its_voltage_is_believed_within_reason() -> None:
    assert replies.battery(b'{"batteryLow": true, "voltage": 18.5}') == Battery(True, 18.5)
    assert replies.battery(b'{"batteryLow": false, "voltage": 6475}') == Battery(False, None)
    assert replies.battery(b'{"batteryLow": false, "voltage": true}') == Battery(False, None)
    assert replies.battery(b'{"batteryLow": false}') == Battery(False, None)
    for body in (b"", b'{"batteryLow": 0}', b'{"voltage": 18.5}'):
        with pytest.raises(BadMessage):
            replies.battery(body)


@FAST
@given(st.binary(max_size=200))
def test_no_bytes_do_more_than_be_refused(body: bytes) -> None:
    for parse in (replies.odometry, replies.bumper, replies.battery):
        with suppress(BadMessage):
            parse(body)


plain = st.recursive(
    st.one_of(st.none(), st.booleans(), st.floats(), st.integers(), st.text(max_size=5)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=8), st.dictionaries(st.text(max_size=12), inner, max_size=4)
    ),
    max_leaves=10,
)


@FAST
@given(plain)
def test_no_json_does_more_than_be_refused(tree: object) -> None:
    body = json.dumps(tree).encode()
    for parse in (replies.odometry, replies.bumper, replies.battery):
        with suppress(BadMessage):
            parse(body)
