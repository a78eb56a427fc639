"""Keys, tokens and attachments of both ways to a ROS 2 robot, and which velocity it takes."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.robot_driver.real import ros2_names
from services.robot_driver.real.ros2_names import Attachment, Endpoint
from shared.config import Ros2Config
from shared.errors import ConfigError
from shared.settings import load as settings_of

FAST = settings(deadline=None, max_examples=60, derandomize=True)

TWIST, STAMPED = ros2_names.VELOCITY_TYPES["Twist"], ros2_names.VELOCITY_TYPES["TwistStamped"]
HASH = "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a"
ZID = "aac3178e146ba6f1fc6e6a4085e77f21"
NOBODY = {"Twist": False, "TwistStamped": False}
BOTH = {"Twist": True, "TwistStamped": True}


def test_topics_have_their_namespace_and_no_leading_slash() -> None:
    assert ros2_names.full_topic("", "cmd_vel") == "cmd_vel"
    assert ros2_names.full_topic("bot1", "oakd/rgb") == "bot1/oakd/rgb"
    assert ros2_names.full_topic("a/b/", "odom") == "a/b/odom"
    assert ros2_names.full_topic("", "/cmd_vel") == "cmd_vel"
    assert ros2_names.full_topic("/bot1", "/odom") == "bot1/odom"


@pytest.mark.parametrize("name", ["/cmd_vel", "cmd_vel", "/bot1/odom", "_a/b_2"])
def test_ros_names_are_taken_with_and_without_a_leading_slash(name: str) -> None:
    config = Ros2Config(odometry_topic=name, namespace=name, battery_topic=name)
    assert config.odometry_topic == name
    assert Ros2Config(namespace="", battery_topic="").battery_topic == ""


@pytest.mark.parametrize(
    "name", ["*", "a/**", "a$*", "a?", "a#b", "a//b", "//a", "a/", "/", "1a", "a b", "~/a"]
)
def test_names_that_would_be_patterns_or_none_are_refused_with_an_example(name: str) -> None:
    for field in ("odometry_topic", "namespace", "battery_topic"):
        with pytest.raises(ConfigError) as caught:
            settings_of(None, overrides=[f"robot.ros2.{field}={name}"])
        told = f"robot.ros2.{field}: expected a ROS name such as 'cmd_vel' or '/bot1/odom', got"
        assert str(caught.value).startswith(told)


def test_keys_of_rmw_zenoh_name_domain_topic_type_and_hash() -> None:
    key = ros2_names.rmw_key(0, "cmd_vel", TWIST, HASH)
    assert key == f"0/cmd_vel/geometry_msgs::msg::dds_::Twist_/{HASH}"
    any_hash = ros2_names.rmw_key(7, "bot1/odom", "nav_msgs/msg/Odometry", ros2_names.ANY_HASH)
    assert any_hash == "7/bot1/odom/nav_msgs::msg::dds_::Odometry_/*"


def test_attachments_have_the_known_bytes() -> None:
    raw = ros2_names.packed(Attachment(1, 2, bytes(range(16))))
    assert raw.hex() == "0100000000000000" + "0200000000000000" + "10" + bytes(range(16)).hex()
    assert len(raw) == ros2_names.ATTACHMENT_BYTES == 33


@FAST
@given(st.integers(0, 2**63 - 1), st.integers(0, 2**63 - 1), st.binary(min_size=16, max_size=16))
def test_attachments_come_back(sequence: int, stamp_ns: int, gid: bytes) -> None:
    attachment = Attachment(sequence, stamp_ns, gid)
    assert ros2_names.unpacked(ros2_names.packed(attachment)) == attachment


@FAST
@given(st.binary(max_size=64))
def test_other_bytes_are_no_attachment(raw: bytes) -> None:
    read = ros2_names.unpacked(raw)
    assert read is None or (len(raw) == 33 and raw[16] == 16)


def test_numbers_beyond_an_attachment_are_refused() -> None:
    with pytest.raises(ValueError, match="attachment"):
        ros2_names.packed(Attachment(2**63, 0, bytes(16)))


def test_tokens_of_the_bridge_in_both_forms() -> None:
    endpoint = Endpoint("listens", "bot1/cmd_vel", TWIST)
    key = "MS/bot1§cmd_vel/geometry_msgs§msg§Twist/:::1,10"
    assert ros2_names.parsed_token(f"@/{ZID}/@ros2_lv/{key}", 0) == endpoint
    assert ros2_names.parsed_token(f"@ros2_lv/{ZID}/{key}", 0) == endpoint
    assert ros2_names.parsed_token(ros2_names.bridge_token(ZID, endpoint), 0) == endpoint


def test_tokens_of_rmw_zenoh() -> None:
    key = (
        f"@ros2_lv/2/{ZID}/0/11/MP/%/%/talker/%bot1%odom/nav_msgs::msg::dds_::Odometry_/{HASH}/"
        "::,10:,:,:,,"
    )
    endpoint = Endpoint("publishes", "bot1/odom", "nav_msgs/msg/Odometry")
    assert ros2_names.parsed_token(key, 2) == endpoint
    assert ros2_names.parsed_token(key, 0) is None, "another domain"
    own = ros2_names.rmw_token(2, ZID, 11, endpoint, HASH, "talker")
    assert own == key


@pytest.mark.parametrize(
    "key",
    [
        f"@ros2_lv/0/{ZID}/0/0/NN/%/%/talker",
        f"@ros2_lv/0/{ZID}/0/10/SS/%/%/t/%t%get/rcl_interfaces::srv::dds_::Get_/{HASH}/::,:,:,:,,",
        f"@/{ZID}/@ros2_lv",
        f"@/{ZID}/@ros2_lv/SC/add/example§srv§Add",
        f"@/{ZID}/@ros2_lv/XX/add/example§srv§Add/x",
        "",
        "/////////////",
    ],
)
def test_other_tokens_tell_nothing(key: str) -> None:
    assert ros2_names.parsed_token(key, 0) is None


@FAST
@given(st.text(st.sampled_from("@/ros2_lv%§:MSP*0"), max_size=60))
def test_no_token_breaks_the_parser(key: str) -> None:
    ros2_names.parsed_token(key, 0)


@pytest.mark.parametrize("transport", ["bridge", "rmw-zenoh"])
@pytest.mark.parametrize("configured", ["auto", "Twist"])
def test_what_the_robot_listens_for_is_sent(transport: str, configured: str) -> None:
    choice = ros2_names.velocity_type(configured, "cmd_vel", frozenset({TWIST}), BOTH, transport)
    assert choice == ("Twist", "")


@pytest.mark.parametrize("transport", ["bridge", "rmw-zenoh"])
def test_another_type_than_configured_is_an_obstacle(transport: str) -> None:
    listening = frozenset({STAMPED})
    kind, obstacle = ros2_names.velocity_type("Twist", "cmd_vel", listening, BOTH, transport)
    assert (kind, obstacle) == ("", "robot listens for TwistStamped on cmd_vel, configured Twist")


@pytest.mark.parametrize("transport", ["bridge", "rmw-zenoh"])
@pytest.mark.parametrize("configured", ["auto", "Twist"])
@pytest.mark.parametrize("listening", [frozenset(), frozenset({TWIST})])
def test_nobody_who_listens_is_an_obstacle(
    transport: str, configured: str, listening: frozenset[str]
) -> None:
    _, obstacle = ros2_names.velocity_type(configured, "cmd_vel", listening, NOBODY, transport)
    if listening and transport == "rmw-zenoh":
        assert "robot.ros2.distribution" in obstacle
    else:
        assert obstacle == "nothing on the robot listens on cmd_vel"


def test_a_network_that_does_not_tell_types_needs_one_configured() -> None:
    for transport in ("bridge", "rmw-zenoh"):
        kind, obstacle = ros2_names.velocity_type("auto", "x", frozenset(), BOTH, transport)
        assert kind == ""
        assert "robot.ros2.velocity_type" in obstacle
        choice = ros2_names.velocity_type("Twist", "x", frozenset(), BOTH, transport)
        assert choice == ("Twist", "")


def test_keys_with_types_tell_them_without_tokens() -> None:
    matching = {"Twist": False, "TwistStamped": True}
    choice = ros2_names.velocity_type("auto", "x", frozenset(), matching, "rmw-zenoh")
    assert choice == ("TwistStamped", "")


def test_listeners_of_two_types_on_one_key_are_an_obstacle() -> None:
    both = frozenset({TWIST, STAMPED})
    for configured in ("auto", "Twist"):
        kind, obstacle = ros2_names.velocity_type(configured, "x", both, BOTH, "bridge")
        assert kind == ""
        assert "Twist and TwistStamped" in obstacle
    assert ros2_names.velocity_type("Twist", "x", both, BOTH, "rmw-zenoh") == ("Twist", "")


def test_a_type_that_is_no_velocity_is_an_obstacle() -> None:
    listening = frozenset({"geometry_msgs/msg/Vector3"})
    for configured in ("auto", "Twist", "TwistStamped"):
        kind, obstacle = ros2_names.velocity_type(configured, "x", listening, BOTH, "bridge")
        assert kind == ""
        assert "robot listens for Vector3 on x" in obstacle
