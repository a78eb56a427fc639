"""What the sensors of a ROS 2 robot send, judged and put into slots (no clock, no network)."""

import logging
import math
from collections.abc import Callable
from typing import Any

from services.robot_driver.real import cdr, ros2_names, ros2_types
from services.robot_driver.real.cdr import Stamped
from services.robot_driver.real.freshness import Pictures, RobotClock, Sequences, Stamps
from services.robot_driver.real.link import Newest, Slots
from services.robot_driver.real.ros2_names import Endpoint
from shared.config import Ros2Config
from shared.errors import BadMessage
from shared.foreign_bus import RawSample
from shared.rl.preprocess import preprocess

log = logging.getLogger(__name__)
SENSORS = ("bumper", "odometry", "battery", "camera")
"""The most urgent first."""
TOUCH_S = 0.03
"""A touch is shown at least this long, so that whoever watches the slot sees it."""
BEHIND_S = 1.0
BEHIND = "made long before other messages: late, or of another clock (robot.ros2.camera_clock)"
"""Why a sensor is old whose messages were made so long before they came."""
AT_A_PERIOD = "set hazards_pub_fixed_period_ms to 50 on the base"
PRESS = f"press it once, or {AT_A_PERIOD} and robot.ros2.bumper_on_change to false"


class Ros2Sensors(Slots):
    """The sensors of a ROS 2 robot: slots of `link.Link`, and what is known of their messages.

    A bumper that is published on change alone is silent for hours. Once it was heard, every new
    odometry shows that the robot still talks, while the network tells that somebody publishes it.
    """

    def __init__(self, ros: Ros2Config) -> None:
        super().__init__()
        self._ros = ros
        topics = {part: getattr(ros, f"{part}_topic") for part in ("velocity", *SENSORS)}
        self._topics = {
            part: ros2_names.full_topic(ros.namespace, topic)
            for part, topic in topics.items()
            if topic
        }
        self._kinds: dict[str, str] = {
            "bumper": ros.bumper_type,
            "odometry": "Odometry",
            "camera": ros.camera_type,
            "battery": ros.battery_type,
        }
        self._decoders: dict[str, Callable[[bytes], Stamped[Any]]] = {
            "bumper": lambda raw: cdr.decode_bumper(raw, ros.bumper_type),
            "odometry": cdr.decode_odometry,
            "camera": lambda raw: cdr.decode_camera(raw, ros.camera_type),
            "battery": lambda raw: cdr.decode_battery(raw, ros.battery_type, percent=self._percent),
        }
        self._robot_clock = RobotClock()
        own = RobotClock() if ros.camera_clock == "own" else self._robot_clock
        self._clocks = {**dict.fromkeys(SENSORS, self._robot_clock), "camera": own}
        self._stamps = {name: Stamps(self._clocks[name]) for name in SENSORS}
        self._sequences = {name: Sequences() for name in SENSORS}
        self._pictures = Pictures()
        self._endpoints: frozenset[Endpoint] = frozenset()
        self._bumper_told = False
        """Whether the network ever told of somebody who publishes the bumper."""
        self._touch_until_s = -math.inf
        self._percent = False
        """Whether the battery told its charge in percent."""
        self._hints: dict[str, str] = {}
        self._epoch_s = 0.0
        """The time of day less our monotonic clock."""

    def take(self, name: str, sample: RawSample, now_s: float) -> None:
        """Take one message; what cannot be read, repeats or comes late is counted."""
        before = self.bumper.get()
        try:
            read = self._decoders[name](sample.payload)
            made_s = self._made_s(name, sample, read.stamp_ns)
            if made_s is not None:
                self._accept(name, read, sample, made_s)
        except BadMessage as error:
            self.refuse(name, str(error))
        except Exception as error:  # one odd message must not end all reading
            log.exception("%s: could not be taken", name)
            self.refuse(name, type(error).__name__)
        after = self.bumper.get()
        if after is not None and after.value and not (before is not None and before.value):
            self._touch_until_s = now_s + TOUCH_S

    def _wrong_sensor(self) -> str:
        """A sensor that the robot publishes as another type; what it sends would mean nothing."""
        for name, topic in self._topics.items():
            told = ros2_names.types_on(self._endpoints, "publishes", topic)
            if name != "velocity" and told and ros2_types.FULL_NAMES[self._kinds[name]] not in told:
                types = " and ".join(sorted(ros2_names.short(full) for full in told))
                return f"robot publishes {types} on {topic}, configured {self._kinds[name]}"
        return ""

    def _accept(self, name: str, read: Stamped[Any], sample: RawSample, made_s: float) -> None:
        """Put a new reading, with how long it took and how far the robot's clock is from ours."""
        value = read.value
        if name == "camera":
            here = self.odometry.get()
            if not self._pictures.new(value, here.value if here else None, made_s):
                raise BadMessage("the same picture although the robot moved")
            value = preprocess(value)
        elif name == "battery":
            self._percent |= (value.charge or 0.0) > cdr.FULL
        apart_s, behind_s = self._clocks[name].apart_s, sample.arrived_s - made_s
        skew = "no stamps" if apart_s is None else f"clock {-apart_s - self._epoch_s:+.3f} s"
        slot: Newest[Any] = getattr(self, name)
        slot.put(value, made_s, f"{read.facts}{behind_s:.3f} s on its way, {skew}")
        slot.note = BEHIND if behind_s > BEHIND_S else ""
        if name == "odometry" and self._ros.bumper_on_change:
            self._confirm_bumper(made_s)

    def _confirm_bumper(self, made_s: float) -> None:
        """The robot talks: its bumper, told on change alone, is still as it was last told."""
        there = ros2_names.types_on(self._endpoints, "publishes", self._topics["bumper"])
        self._bumper_told |= bool(there)
        # Where the network tells who publishes, a publisher that went takes the all-clear with it.
        last = self.bumper.get()
        if last is not None and (there or not (self._bumper_told or self._endpoints)):
            self.bumper.put(last.value, made_s)

    def _made_s(self, name: str, sample: RawSample, stamp_ns: int) -> float | None:
        """When a sample was made, on our clock; None for one that repeats or comes late."""
        stamps = self._stamps[name]
        if self._ros.transport == "rmw-zenoh":
            attachment = ros2_names.unpacked(sample.attachment)
            if attachment is None:
                raise BadMessage("without the attachment of rmw_zenoh")
            if not self._sequences[name].new(attachment.gid, attachment.sequence):
                self.count(name, "repeated or late")
                return None
        made_s = stamps.made_s(stamp_ns, sample.arrived_s)
        if made_s is None and name == "bumper" and not stamps.copied:
            raise BadMessage("repeated or late")
        if made_s is None:
            self.count(name, "repeated or late")
        return made_s

    def explain(self) -> None:
        """Let sensors without a reading say what the network tells of them, or what to do."""
        for name in self._kinds.keys() & self._topics.keys():
            slot: Newest[Any] = getattr(self, name)
            if slot.get() is None and slot.note in ("", self._hints.get(name)):
                self._hints[name] = slot.note = self._hint(name)

    def _hint(self, name: str) -> str:
        topic = self._topics[name]
        if self._endpoints and not ros2_names.types_on(self._endpoints, "publishes", topic):
            return f"nobody publishes on {topic}"
        if name == "bumper" and self._ros.bumper_on_change:
            return PRESS
        return AT_A_PERIOD if self._kinds[name] == "HazardDetectionVector" else "nothing heard"
