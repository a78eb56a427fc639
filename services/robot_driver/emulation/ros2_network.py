"""The keys, tokens and publishers of an emulated ROS 2 robot on its Zenoh network."""

import secrets
import time
from typing import Literal

from services.robot_driver.emulation.ros2_faults import FAULTS_KEY, TRUTH_KEY
from services.robot_driver.real import ros2_names, ros2_types
from services.robot_driver.real.ros2_names import Attachment, Endpoint
from services.robot_driver.real.ros2_types import VelocityType
from shared.config import Ros2Config
from shared.foreign_bus import ForeignBus, RawInbox, RawPublisher, Undeclare

SENSORS = ("odometry", "camera", "bumper", "battery")


class Network:
    """One session of the robot: keys, tokens, publishers. Raises ConfigError: it cannot listen."""

    def __init__(self, listen: str, ros: Ros2Config, inbox: RawInbox) -> None:
        self._ros, self._inbox = ros, inbox
        self._bus = bus = ForeignBus(listen, "router")
        self.endpoint = bus.endpoint
        self._entities = 0
        self._listening: list[Undeclare] = []
        self._bumper_token: Undeclare | None = None
        self._gid = {name: secrets.token_bytes(16) for name in SENSORS}
        self._sequence = dict.fromkeys(SENSORS, 0)
        self.publishers: dict[str, RawPublisher] = {}
        sensors = {
            "odometry": (ros.odometry_topic, "Odometry"),
            "camera": (ros.camera_topic, ros.camera_type),
            "bumper": (ros.bumper_topic, ros.bumper_type),
        }
        if ros.battery_topic:
            sensors["battery"] = (ros.battery_topic, ros.battery_type)
        self.kinds = {name: kind for name, (_, kind) in sensors.items()}
        """Short names of the sensors' types."""
        for name, (topic, kind) in sensors.items():
            self.publishers[name] = bus.publisher(self._key(topic, kind))
            if name != "bumper":
                self._announce("publishes", topic, kind)
        for key in (FAULTS_KEY, TRUTH_KEY):
            bus.serve(inbox, "questions", key)

    def listen(self, kind: VelocityType | None) -> None:
        """Take velocities of this type from now on, or none."""
        for undeclare in self._listening:
            undeclare()
        self._listening = []
        if kind is not None:
            topic = self._ros.velocity_topic
            self._listening = [
                self._bus.subscribe(
                    self._inbox, "velocity", self._key(topic, kind), max_bytes=4096, keep=16
                ),
                self._announce("listens", topic, kind),
            ]

    def show_bumper(self, there: bool) -> None:
        """Let the network know of a publisher of the bumper, or of none."""
        if there and self._bumper_token is None:
            topic, kind = self._ros.bumper_topic, self._ros.bumper_type
            self._bumper_token = self._announce("publishes", topic, kind)
        elif not there and self._bumper_token is not None:
            self._bumper_token()
            self._bumper_token = None

    def attachment(self, name: str) -> bytes:
        """What goes with the next message of a sensor; nothing through the bridge."""
        if self._ros.transport == "bridge":
            return b""
        self._sequence[name] += 1
        return ros2_names.packed(Attachment(self._sequence[name], time.time_ns(), self._gid[name]))

    def close(self) -> None:
        """Leave the network."""
        self._bus.close()

    def _key(self, topic: str, kind: str) -> str:
        full = ros2_names.full_topic(self._ros.namespace, topic)
        return ros2_types.key_of(self._ros, full, kind)

    def _announce(
        self, direction: Literal["publishes", "listens"], topic: str, kind: str
    ) -> Undeclare:
        full = ros2_names.full_topic(self._ros.namespace, topic)
        endpoint = Endpoint(direction, full, ros2_types.FULL_NAMES[kind])
        if self._ros.transport == "bridge":
            return self._bus.token(ros2_names.bridge_token(self._bus.zid, endpoint))
        self._entities += 1
        return self._bus.token(
            ros2_names.rmw_token(
                self._ros.domain,
                self._bus.zid,
                self._entities,
                endpoint,
                ros2_types.type_hash(kind, self._ros.distribution),
                "emulator",
            )
        )
