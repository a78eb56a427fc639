"""The link to a ROS 2 robot against a robot played by hand: what it believes, and what it sends."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing

import numpy as np
import pytest
from robots import BRIDGE, RMW_ZENOH, real_time, ros2_emulator

from benchmarks.waiting import wait_until
from services.robot_driver.emulation.ros2_faults import Ros2Faults
from services.robot_driver.real import cdr, ros2_names, ros2_types
from services.robot_driver.real.ros2 import Ros2Link
from services.robot_driver.real.ros2_names import Attachment, Endpoint
from services.robot_driver.robot import STANDSTILL, Pose, RobotFault, Velocity
from shared.errors import RouterMissing
from shared.foreign_bus import ForeignBus, RawInbox, RawPublisher, RawSample

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]
AHEAD = Velocity(0.2, 0.0, -0.5)
HERE = Pose(1.0, 2.0, 0.5)
S_NS = 10**9
PATIENCE_S = 60.0


class Hand:
    """A robot behind the bridge, whose every message a test chooses."""

    def __init__(self) -> None:
        self.bus = ForeignBus("tcp/127.0.0.1:0", "router")
        self.inbox = RawInbox()
        self._publishers: dict[str, RawPublisher] = {}

    def listen(self, kind: str = "Twist", topic: str = "cmd_vel") -> Callable[[], None]:
        """Listen for velocities; returns what ends that."""
        endpoint = Endpoint("listens", topic, ros2_names.VELOCITY_TYPES[kind])
        token = self.bus.token(ros2_names.bridge_token(self.bus.zid, endpoint))
        subscriber = self.bus.subscribe(self.inbox, "velocity", topic, max_bytes=4096, keep=64)

        def end() -> None:
            token()
            subscriber()

        return end

    def publishes(self, topic: str, kind: str) -> Callable[[], None]:
        """Tell that somebody publishes a topic; returns what ends that."""
        endpoint = Endpoint("publishes", topic, ros2_types.FULL_NAMES[kind])
        return self.bus.token(ros2_names.bridge_token(self.bus.zid, endpoint))

    def say(self, topic: str, raw: bytes, attachment: bytes = b"") -> None:
        if topic not in self._publishers:
            self._publishers[topic] = self.bus.publisher(topic)
            publisher = self._publishers[topic]
            wait_until(lambda: publisher.matching, PATIENCE_S, f"the link listens on {topic}")
        self._publishers[topic].put(raw, attachment)

    def odometry(self, stamp_ns: int, pose: Pose = HERE) -> None:
        self.say("odom", cdr.encode_odometry(pose, STANDSTILL, stamp_ns))

    def command(self) -> RawSample:
        found = wait_until(lambda: self.inbox.take("velocity"), PATIENCE_S, "a command")
        assert found is not None
        return found


@pytest.fixture
def hand() -> Iterator[Hand]:
    one = Hand()
    with closing(one.bus):
        yield one


def linked(hand: Hand, **ros2: object) -> closing[Ros2Link]:
    link = Ros2Link(real_time(kind="ros2", ros2={**ros2, "endpoint": hand.bus.endpoint}))
    link.open()
    return closing(link)


def wait_obstacle(link: Ros2Link, text: str) -> None:
    wait_until(lambda: link.obstacle() == text, PATIENCE_S, f"obstacle {text!r}")


# ---------------------------------------------------------------- commands


@pytest.mark.parametrize("kind", ["Twist", "TwistStamped"])
def test_it_sends_what_the_robot_listens_for(kind: str, hand: Hand) -> None:
    with linked(hand) as link:
        assert link.obstacle() == "nothing on the robot listens on cmd_vel"
        hand.listen(kind)
        wait_obstacle(link, "")
        link.send(AHEAD)
        raw = hand.command().payload
        assert cdr.decode_velocity(raw, kind).value == AHEAD  # type: ignore[arg-type]
        link.send(STANDSTILL)
        raw = hand.command().payload
        assert cdr.decode_velocity(raw, kind).value == STANDSTILL  # type: ignore[arg-type]


def test_it_refuses_to_drive_what_listens_for_another_type(hand: Hand) -> None:
    with linked(hand, velocity_type="Twist") as link:
        end = hand.listen("TwistStamped")
        told = "robot listens for TwistStamped on cmd_vel, configured Twist"
        wait_obstacle(link, told)
        for velocity in (AHEAD, STANDSTILL):  # to such a listener even zeros mean something else
            with pytest.raises(RobotFault, match="listens for TwistStamped"):
                link.send(velocity)
        end()
        hand.listen("Twist")
        wait_obstacle(link, "")
        link.send(AHEAD)
        assert len(hand.command().payload) == 52


def test_nobody_who_listens_is_driven_but_may_be_stopped(hand: Hand) -> None:
    """A stop is published all the same, but does not count as one that arrived."""
    with linked(hand, velocity_type="Twist") as link:
        for velocity in (AHEAD, STANDSTILL):
            with pytest.raises(RobotFault, match="nothing on the robot listens on cmd_vel"):
                link.send(velocity)
        assert sum(link.faults[name] for name in link.faults if name.startswith("command")) == 2
        hand.listen("Twist")
        wait_obstacle(link, "")
        link.send(STANDSTILL)


def test_velocities_that_are_not_finite_are_refused(hand: Hand) -> None:
    with linked(hand) as link:
        hand.listen()
        wait_obstacle(link, "")
        with pytest.raises(RobotFault, match="finite"):
            link.send(Velocity(math.nan, 0.0, 0.0))
        assert hand.inbox.take("velocity") is None


def test_stamps_are_of_the_robots_clock_and_grow(hand: Hand) -> None:
    with linked(hand, velocity_type="TwistStamped") as link:
        hand.listen("TwistStamped")
        wait_obstacle(link, "")
        link.send(AHEAD)
        assert cdr.decode_velocity(hand.command().payload, "TwistStamped").stamp_ns == 0
        robots_ns = 5_000 * S_NS
        hand.odometry(robots_ns)
        assert link.odometry.wait(0, PATIENCE_S)
        stamps = []
        for _ in range(3):
            link.send(AHEAD)
            stamps.append(cdr.decode_velocity(hand.command().payload, "TwistStamped").stamp_ns)
        assert robots_ns <= stamps[0] < stamps[1] < stamps[2] < robots_ns + 60 * S_NS


def test_rmw_zenoh_gets_the_exact_key_and_an_attachment_that_counts(hand: Hand) -> None:
    key = ros2_names.rmw_key(
        3, "bot1/cmd_vel", ros2_types.FULL_NAMES["Twist"], ros2_types.type_hash("Twist")
    )
    hand.bus.subscribe(hand.inbox, "velocity", key, max_bytes=4096, keep=16)
    settings = {"transport": "rmw-zenoh", "domain": 3, "namespace": "bot1"}
    with linked(hand, **settings) as link:
        wait_obstacle(link, "")  # no token: the key that somebody listens on tells the type
        gids = set()
        for number in (1, 2, 3):
            link.send(AHEAD)
            attachment = ros2_names.unpacked(hand.command().attachment)
            assert attachment is not None
            assert attachment.sequence == number
            gids.add(attachment.gid)
        assert len(gids) == 1


def test_humble_has_no_hashes(hand: Hand) -> None:
    key = ros2_names.rmw_key(0, "cmd_vel", ros2_types.FULL_NAMES["Twist"], "TypeHashNotSupported")
    hand.bus.subscribe(hand.inbox, "velocity", key, max_bytes=4096, keep=16)
    settings = {"transport": "rmw-zenoh", "velocity_type": "Twist"}
    with linked(hand, **settings, distribution="humble") as link:
        wait_obstacle(link, "")
    with linked(hand, **settings, distribution="jazzy") as link:
        assert "nothing on the robot listens" in link.obstacle()


# ---------------------------------------------------------------- readings


def test_odometry_counts_once_and_only_forwards(hand: Hand) -> None:
    with linked(hand) as link:

        def taken() -> int:
            reading = link.odometry.get()
            return reading.number if reading else 0

        def told() -> int:
            return taken() + link.faults["odometry: repeated or late"]

        for count, stamp_ns in enumerate((5, 6, 6, 5, 4, 6, 7), 1):
            hand.odometry(stamp_ns, Pose(float(stamp_ns), 0.0, 0.0))
            wait_until(lambda count=count: told() == count, PATIENCE_S, "taken or counted")  # type: ignore[misc]
        newest = link.odometry.get()
        assert newest is not None
        assert (newest.value.x_m, newest.number) == (7.0, 3)


def test_a_sensor_of_another_type_than_configured_is_an_obstacle(hand: Hand) -> None:
    with linked(hand) as link:
        hand.listen()
        end = hand.publishes("image_raw", "CompressedImage")
        wait_obstacle(link, "robot publishes CompressedImage on image_raw, configured Image")
        end()
        wait_obstacle(link, "")


def test_what_is_refused_is_counted_by_reason_and_leaves_the_reading_old(hand: Hand) -> None:
    with linked(hand) as link:
        hand.say("odom", cdr.encode_odometry(HERE, STANDSTILL, 5)[:-9])
        hand.say("bumper", b"")
        hand.say("image_raw", cdr.encode_image(np.zeros((5, 5, 3), np.uint8), 1)[:20])
        hand.say("bumper", bytes(1000))
        for fault in (
            "odometry: truncated or of another type",
            "bumper: empty",
            "camera: truncated or of another type",
            "bumper: too long or too many",
        ):
            wait_until(lambda fault=fault: link.faults[fault], PATIENCE_S, fault)  # type: ignore[misc]
        assert (link.odometry.get(), link.bumper.get(), link.camera.get()) == (None, None, None)


def test_the_shortest_touch_is_seen(hand: Hand) -> None:
    """Pressed and released in one go: whoever waits for readings sees both."""
    with linked(hand) as link:
        seen: list[bool] = []
        done = threading.Event()

        def watch() -> None:
            number = 0
            while not done.is_set():
                if reading := link.bumper.wait(number, 0.1):
                    number = reading.number
                    seen.append(reading.value)

        thread = threading.Thread(target=watch)
        thread.start()
        try:
            hand.say("bumper", cdr.encode_bumper(False, "Bool"))
            wait_until(lambda: seen == [False], PATIENCE_S, "released")
            for pressed in (True, False):
                hand.say("bumper", cdr.encode_bumper(pressed, "Bool"))
            wait_until(lambda: seen[-1] is False and len(seen) > 1, PATIENCE_S, "released again")
            assert True in seen
        finally:
            done.set()
            thread.join()


def test_rmw_zenoh_samples_count_once_and_only_with_their_attachment(hand: Hand) -> None:
    with linked(hand, transport="rmw-zenoh") as link:
        key = ros2_names.rmw_key(
            0, "bumper", ros2_types.FULL_NAMES["Bool"], ros2_types.type_hash("Bool")
        )
        released, pressed = (cdr.encode_bumper(value, "Bool") for value in (False, True))
        gid = bytes(16)
        hand.say(key, pressed)
        wait_until(
            lambda: link.faults["bumper: without the attachment of rmw_zenoh"], PATIENCE_S, "no"
        )
        assert link.bumper.get() is None
        first, second = (ros2_names.packed(Attachment(n, n, gid)) for n in (1, 2))
        hand.say(key, released, first)
        hand.say(key, pressed, second)
        hand.say(key, released, first)  # comes late: it does not release the bumper
        wait_until(lambda: link.faults["bumper: repeated or late"], PATIENCE_S, "counted")
        wait_until(lambda: link.bumper.get(), PATIENCE_S, "a reading")
        reading = link.bumper.get()
        assert reading is not None
        assert reading.value is True


# ---------------------------------------------------------------- bumpers told on change


ON_CHANGE: dict[str, object] = {
    "bumper_on_change": True,
    "bumper_topic": "hazard_detection",
    "bumper_type": "HazardDetectionVector",
}


def test_a_silent_bumper_is_unknown_whoever_publishes_it(hand: Hand) -> None:
    with linked(hand, **ON_CHANGE) as link:
        hand.listen()
        wait_obstacle(link, "")
        wait_until(
            lambda: link.bumper.note == "nobody publishes on hazard_detection", 60, "it says"
        )
        hand.publishes("hazard_detection", "HazardDetectionVector")
        for stamp_ns in (1, 2, 3):
            hand.odometry(stamp_ns)
            assert link.odometry.wait(stamp_ns - 1, PATIENCE_S)
        assert link.bumper.get() is None
        wait_until(lambda: link.bumper.note.startswith("press it once"), 60, "what to do")


def test_odometry_keeps_a_bumper_fresh_while_somebody_publishes_it(hand: Hand) -> None:
    with linked(hand, **ON_CHANGE) as link:
        end = hand.publishes("hazard_detection", "HazardDetectionVector")
        hand.say("hazard_detection", cdr.encode_bumper(False, "HazardDetectionVector", 76))
        stamp_ns = 0

        def fresh() -> bool:
            nonlocal stamp_ns
            stamp_ns += 1
            before = link.bumper.get()
            hand.odometry(stamp_ns)
            assert link.odometry.wait(stamp_ns - 1, PATIENCE_S)
            return link.bumper.wait(before.number if before else 0, 0.5) is not None

        wait_until(fresh, PATIENCE_S, "the bumper is released")
        reading = link.bumper.get()
        assert reading is not None
        assert reading.value is False
        hand.say("hazard_detection", cdr.encode_bumper(True, "HazardDetectionVector", 77))
        wait_until(lambda: pressed(link), PATIENCE_S, "pressed")
        assert fresh()
        assert pressed(link), "until the robot says otherwise"
        hand.say("hazard_detection", cdr.encode_bumper(False, "HazardDetectionVector", 78))
        wait_until(lambda: not pressed(link), PATIENCE_S, "released")
        end()
        wait_until(lambda: not fresh(), PATIENCE_S, "without a publisher it becomes old")


def pressed(link: Ros2Link) -> bool:
    reading = link.bumper.get()
    return reading is not None and reading.value


# ---------------------------------------------------------------- connections


def test_without_a_router_it_gives_up_in_time_and_says_where() -> None:
    config = real_time(
        kind="ros2", ros2={"endpoint": "tcp/127.0.0.1:1"}, hardware={"open_timeout_s": 0.2}
    )
    link = Ros2Link(config)
    with pytest.raises(RobotFault, match=r"robot\.ros2\.endpoint"):
        link.open()
    assert link.obstacle() == "not connected to the robot"
    with pytest.raises(RobotFault, match="not connected"):
        link.send(STANDSTILL)
    link.close()
    link.close()


@pytest.mark.parametrize("ros2", [BRIDGE, RMW_ZENOH], ids=["bridge", "rmw-zenoh"])
def test_it_finds_a_robot_again_that_was_gone(ros2: dict[str, object]) -> None:
    with ros2_emulator(Ros2Faults(), **ros2) as emulated:
        config = real_time(kind="ros2", ros2={**ros2, "endpoint": emulated.endpoint})
        link = Ros2Link(config)
        with closing(link):
            link.open()
            wait_obstacle(link, "")
            emulated.change({"closed_s": 1.0})
            wait_until(lambda: link.obstacle(), PATIENCE_S, "it is gone")
            gone_s = time.monotonic()
            wait_obstacle(link, "")
            emulated.change({"bumper": "stuck"})  # told on change, it says nothing before
            for slot in (link.odometry, link.camera, link.bumper):
                wait_until(
                    lambda slot=slot: (r := slot.get()) and r.stamp_s > gone_s,  # type: ignore[misc]
                    PATIENCE_S,
                    "a new reading",
                )
            link.send(AHEAD)
            wait_until(lambda: emulated.truth()["counts"].get("commands"), PATIENCE_S, "driven")


def test_a_closed_session_says_so() -> None:
    hand = Hand()
    publisher = hand.bus.publisher("x")
    hand.bus.close()
    hand.bus.close()
    with pytest.raises(RouterMissing):
        publisher.put(b"y")
