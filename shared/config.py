"""The one configuration tree: sections, defaults, ranges and units.

How values are merged into it, and how a wrong one is reported, is the business of
`shared.settings`. Cited constants come from the thesis (A.., Eq ..) and the readings of its errata
(E..), see docs/algorithm.md.
"""

import hashlib
import json
import math
import re
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from shared.facts import DEFAULT_ENDPOINT, DEFAULT_RUN, IMAGE_HEIGHT, IMAGE_WIDTH, NAME
from shared.plugins import POLICIES, RETENTION, ROBOTS, OneOf
from shared.rl.retention.table import STRATEGIES

RobotKind = Annotated[str, AfterValidator(OneOf(ROBOTS, ("sim", "robotino", "ros2")))]
PolicyKind = Annotated[
    str, AfterValidator(OneOf(POLICIES, ("eps-greedy", "roulette", "eps-greedy-roulette")))
]
StrategyName = Annotated[str, AfterValidator(OneOf(RETENTION, tuple(STRATEGIES)))]
"""Other packages may add to these by entry points."""

Name = Annotated[str, Field(pattern=NAME.pattern)]
"""A run, robot or world name: it becomes part of a Zenoh key, so no '/', '*', '$' or spaces."""

Probability = Annotated[float, Field(ge=0.0, le=1.0)]


class Section(BaseModel):
    """Base of all sections: frozen, strict, unknown keys refused."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


def _at_most(section: Section, name: str, lower: str, upper: str) -> None:
    """Raise ValueError where one setting of a section exceeds another."""
    low, high = getattr(section, lower), getattr(section, upper)
    if low > high:
        raise ValueError(f"{name}.{lower} ({low}) must not exceed {name}.{upper} ({high})")


class RunConfig(Section):
    """Which run this is."""

    name: Name = DEFAULT_RUN
    """First part of every Zenoh key, so that two runs never mix."""
    seed: int = Field(default=1, ge=0, lt=2**63)
    """The only seed. Every random number is a function of it, a role and a position."""
    episodes: int = Field(default=0, ge=0)
    """Stop the run after this many counted episodes; 0 runs until stopped."""
    robots: tuple[Name, ...] = Field(default=(), max_length=32, strict=False)
    """Robots that an actor serves; empty: all that have no actor of their own."""


class BusConfig(Section):
    """How services reach the Zenoh router."""

    endpoint: str = Field(default=DEFAULT_ENDPOINT, pattern=r"^[a-z][a-z0-9-]*/\S+$")
    """Where clients connect, and where our own router listens."""
    credentials: str = ""
    """Folder with `key.pem`, `cert.pem` and `ca.pem`, or one that `corridor secure init` made;
    empty: no encryption."""
    lease_ms: int = Field(default=2000, ge=200, le=60000)
    """A frozen or cut-off service counts as gone after this time."""
    request_timeout_s: float = Field(default=5.0, gt=0.0, le=120.0)
    """Time for one attempt of a request, which is repeated until it is answered."""
    shared_memory: bool = False
    """Large messages between services of one machine go through shared memory, half as fast again.
    Each restart of a sender costs its receivers 18 MB of locked memory for as long as they run."""
    heartbeat_s: float = Field(default=1.0, gt=0.0, le=10.0)
    """Period of status messages; three missed ones count as silence."""
    hang_s: float = Field(default=60.0, ge=0.0, le=3600.0)
    """`corridor up` kills and restarts a service that sends no status for longer; replay and
    learner after five times, one that just starts after ten times as long. 0: never."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if 0.0 < self.hang_s < 3 * self.heartbeat_s:
            raise ValueError(
                f"bus.hang_s ({self.hang_s}) must be 0 or at least three times bus.heartbeat_s "
                f"({self.heartbeat_s})"
            )
        return self


class CameraConfig(Section):
    """The simulated camera (A1, A22, E31): level, ahead of the centre of the robot."""

    height_m: float = Field(default=0.30, gt=0.0, lt=2.0)
    forward_m: float = Field(default=0.11, ge=0.0, lt=0.5)
    vertical_fov_deg: float = Field(default=45.0, gt=5.0, lt=120.0)
    aspect: float = Field(default=16.0 / 9.0, gt=0.5, lt=4.0)
    """Aspect ratio of the projection, whose picture is squeezed into the network's image (E29)."""
    render_width_px: int = Field(default=IMAGE_WIDTH, ge=IMAGE_WIDTH, le=1920)
    render_height_px: int = Field(default=IMAGE_HEIGHT, ge=IMAGE_HEIGHT, le=1080)


class HardwareConfig(Section):
    """Any real robot: how fresh readings must be, how often commands are sent."""

    command_period_s: float = Field(default=0.1, gt=0.01, le=0.5)
    """The velocity is sent again after this time. It must be below the robot's own watchdog."""
    camera_stale_s: float = Field(default=1.0, gt=0.0, le=5.0)
    """The robot stands still while its newest picture is older."""
    odometry_stale_s: float = Field(default=0.5, gt=0.0, le=5.0)
    """The robot stands still while its newest odometry is older."""
    bumper_stale_s: float = Field(default=0.5, gt=0.0, le=5.0)
    """The robot stands still while its newest bumper reading is older."""
    battery_stale_s: float = Field(default=60.0, gt=0.0, le=3600.0)
    """A battery that was good is unknown when its newest reading is older; a low one stays low."""
    rest_s: float = Field(default=0.7, ge=0.0, le=5.0)
    """Time that the robot needs to come to rest, or to begin to move, its delay included."""
    open_timeout_s: float = Field(default=10.0, gt=0.0, le=120.0)
    """The service ends when the robot has not answered by then. Sensors may answer later."""


class RobotinoConfig(Section):
    """A Festo Robotino 3 or 4 over its REST interface."""

    address: str = Field(
        default="172.26.1.1:80", pattern=r"^(\[[0-9A-Fa-f:]+\]|[A-Za-z0-9._-]+)(:[0-9]{1,5})?$"
    )
    """Host, or host:port."""
    camera_period_s: float = Field(default=0.1, gt=0.0, le=1.0)
    sensor_period_s: float = Field(default=0.1, gt=0.0, le=1.0)
    """Period of bumper and odometry."""
    battery_period_s: float = Field(default=5.0, gt=0.0, le=60.0)
    timeout_s: float = Field(default=0.25, gt=0.0, le=5.0)
    """Longest time of a whole request or command, its answer included."""


def _topic(name: str) -> str:
    """A ROS name; it becomes a Zenoh key, so nothing in it may be a pattern."""
    if re.fullmatch(r"(/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*)?", name):
        return name
    raise PydanticCustomError("ros_name", "a ROS name such as 'cmd_vel' or '/bot1/odom'")


OptionalTopic = Annotated[str, AfterValidator(_topic)]
Topic = Annotated[OptionalTopic, Field(min_length=1)]


class Ros2Config(Section):
    """A ROS 2 robot over Zenoh: through zenoh-bridge-ros2dds, or natively through rmw_zenoh."""

    endpoint: str = Field(
        default=DEFAULT_ENDPOINT, pattern=r"^(tcp|udp|tls|quic)/[^\s/]+:[0-9]{1,5}$"
    )
    """The bridge, or the router of rmw_zenoh, on the robot."""
    transport: Literal["bridge", "rmw-zenoh"] = "bridge"
    domain: int = Field(default=0, ge=0, le=232)
    """ROS_DOMAIN_ID, for rmw-zenoh only."""
    distribution: Literal["humble", "jazzy"] = "jazzy"
    """Humble has no type hashes in its keys. For rmw-zenoh only."""
    namespace: OptionalTopic = ""
    """It is put before every topic. A leading slash of either means nothing."""
    velocity_topic: Topic = "cmd_vel"
    velocity_type: Literal["auto", "Twist", "TwistStamped"] = "auto"
    """auto: the type that the robot listens for, as the network tells."""
    odometry_topic: Topic = "odom"
    camera_topic: Topic = "image_raw"
    camera_type: Literal["Image", "CompressedImage"] = "Image"
    camera_clock: Literal["robot", "own"] = "robot"
    """own: the computer that stamps the pictures has another clock than that of the odometry."""
    bumper_topic: Topic = "bumper"
    bumper_type: Literal["Bool", "HazardDetectionVector"] = "Bool"
    bumper_on_change: bool = False
    """The bumper is published on change only: press it once after each start. Odometry then shows
    that the robot is alive."""
    battery_topic: OptionalTopic = ""
    """Empty: the robot has none."""
    battery_type: Literal["BatteryState", "PowerReadings"] = "BatteryState"


class CalibrationConfig(Section):
    """What a real robot makes of its commands, by `corridor robot calibrate` (E31)."""

    speed_m_s: float = Field(default=0.0, ge=0.0, le=3.0)
    """Speed when told `robot.speed_m_s`; 0: not measured, as it is told."""
    turn_rad_s: float = Field(default=0.0, ge=0.0, le=5.0)
    """Turn rate when told `robot.turn_rad_s`, likewise."""
    delay_s: float = Field(default=0.0, ge=0.0, le=2.0)
    """From a command until the base begins to move."""
    made: str = Field(default="", max_length=200)
    """When, on which robot and with which program it was measured."""


class RobotConfig(Section):
    """The robot, its motion, and the limits its driver enforces whatever the network says."""

    id: Name = "robotino1"
    kind: RobotKind = "sim"
    """The PyBullet simulation, or a real robot, which a section below says how to reach."""
    timing: Literal["lockstep", "realtime"] = "lockstep"
    """lockstep: simulated time waits for each action; realtime: the period is fixed."""
    world: Name = "plus"
    period_s: float = Field(default=0.25, gt=0.01, le=2.0)
    """Time one action lasts."""
    speed_m_s: float = Field(default=0.6, gt=0.0, le=2.0)
    """Forward speed of all actions (A21, E31)."""
    turn_rad_s: float = Field(default=math.radians(80.0), gt=0.0, le=3.0)
    """Turn rate of the actions that turn fully (A21, E31)."""
    max_speed_m_s: float = Field(default=0.8, gt=0.0, le=2.0)
    """Commands are cut to it."""
    max_turn_rad_s: float = Field(default=1.5, gt=0.0, le=3.0)
    """Commands are cut to it."""
    deadman_s: float = Field(default=0.6, gt=0.0, le=10.0)
    """The robot stops if no fresh action came for this long (simulated time in lockstep)."""
    resend_s: float = Field(default=0.5, gt=0.0, le=10.0)
    """Lockstep: an unanswered observation is sent again after this wall-clock time."""
    recovery: Literal["back-off", "none"] = "back-off"
    """What the driver does after a bump (E11). `none` follows the thesis literally."""
    recovery_distance_m: float = Field(default=0.5, gt=0.0, le=1.0)
    recovery_speed_m_s: float = Field(default=0.2, gt=0.0, le=0.5)
    radius_m: float = Field(default=0.225, gt=0.0, le=1.0)
    """Radius of the round shell with the bumper."""
    camera: CameraConfig = CameraConfig()
    calibration: CalibrationConfig = CalibrationConfig()
    hardware: HardwareConfig = HardwareConfig()
    robotino: RobotinoConfig = RobotinoConfig()
    ros2: Ros2Config = Ros2Config()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        _at_most(self, "robot", "speed_m_s", "max_speed_m_s")
        _at_most(self, "robot", "turn_rad_s", "max_turn_rad_s")
        for key, needed in (("timing", "realtime"), ("recovery", "back-off")):
            if self.kind != "sim" and (given := getattr(self, key)) != needed:
                raise ValueError(
                    f"robot.kind '{self.kind}' needs robot.{key} '{needed}', got '{given}'"
                )
        if self.deadman_s < self.period_s:
            raise ValueError(
                f"robot.deadman_s ({self.deadman_s}) must be at least one robot.period_s "
                f"({self.period_s})"
            )
        return self

    @property
    def step_m(self) -> float:
        """Way of an action, as far as is known."""
        return (self.calibration.speed_m_s or self.speed_m_s) * self.period_s

    @property
    def step_rad(self) -> float:
        """Turn of an action that turns fully, as far as is known."""
        return (self.calibration.turn_rad_s or self.turn_rad_s) * self.period_s


class EpisodeConfig(Section):
    """Episode bookkeeping (A9, A10)."""

    max_samples: int = Field(default=500, ge=2, le=5000)
    """An episode ends at a bump or at this many unprocessed samples."""
    horizon: int = Field(default=50, ge=1, le=500)
    """Actions that the reward looks ahead. As many samples are carried over without a bump."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.horizon >= self.max_samples:
            raise ValueError(
                f"episode.horizon ({self.horizon}) must be below episode.max_samples "
                f"({self.max_samples})"
            )
        return self


class RewardConfig(Section):
    """Weights of Eq 3.1 and Eq 3.3."""

    observed_weight: Probability = 0.8
    prediction_weight: Probability = 0.2
    bump_decay: float = Field(default=0.9, gt=0.0, lt=1.0)


class PolicyConfig(Section):
    """How actions are chosen (A18-A20)."""

    kind: PolicyKind = "eps-greedy-roulette"
    epsilon: Probability = 0.1
    """Probability of a choice by chance or roulette (E3)."""
    temperature: float = Field(default=0.01, gt=0.0, le=100.0)


class NetworkConfig(Section):
    """Shape of the Q network (A23, E16)."""

    filters: int = Field(default=64, ge=4, le=256)
    """Filters of each convolution. RMM needs a divisor or a multiple of 16 (A29)."""
    layout: Literal["ccpccp", "cpcccp"] = "ccpccp"
    """Order of convolutions (c) and pools (p). Both orders end in 9x15 maps (E16)."""


class MemoryConfig(Section):
    """Replay memory: capacity, what is discarded, what is refreshed (A27-A35)."""

    capacity: int = Field(default=45000, ge=30, le=5_000_000)
    """The capacity N at the start."""
    capacity_max: int = Field(default=0, ge=0, le=5_000_000)
    """N grows up to this when a search finds too few candidates; 0: never (A44, E32)."""
    capacity_step: int = Field(default=0, ge=0, le=5_000_000)
    """How much N grows at a time; 0: 5000, scaled with `capacity` (A44, E17b)."""
    fill: Literal["random", "policy", "human", "none"] = "random"
    """How the memory is filled before the first episode (A13, E9). human: by a person's actions
    (`corridor takeover`), until it is full."""
    keep_human: bool = True
    """Whether samples of actions that a person chose are stored, like any others. An episode
    without others is not counted then."""
    strategy: StrategyName = "rmm"
    """Which samples are discarded when the memory is full (A28-A34)."""
    rule: Literal["paper", "cover"] = "paper"
    """Whether a sample is compared with all newer ones or only with kept ones (E23)."""
    descriptor: Literal["maps", "first-maps", "fconn1", "thumbnail", "simhash"] = "maps"
    """What images are compared by: maps or FConn1 of the network in force, maps of the first
    network, brightness of neighbours in a thumbnail, or random projections (A29)."""
    mark_share: Probability = 0.0
    """If above 0, a search takes, in place of the threshold, the fewest bits at which this share of
    the samples of actions above their share are candidates."""
    threshold_percent: int = Field(default=1, ge=1, le=100)
    """Similarity threshold at the start, in % of 120 bits (A32, E18). 100: all are similar."""
    threshold_max_percent: int = Field(default=7, ge=1, le=100)
    recompute_below: int = Field(default=0, ge=0)
    """Fewer candidates of an action above its share cause a search; 0: 1000, scaled (A31, E17b)."""
    raise_at_most: int = Field(default=0, ge=0)
    """A search that finds no more raises capacity or threshold; 0: 2000, scaled (A32, E17b)."""
    mark_all_at_episode: int = Field(default=0, ge=0)
    """At this global episode all samples stored before become candidates until they are
    discarded; 0: never (A44)."""
    equalise_every: int = Field(default=50, ge=0)
    """Episodes between reward equalisations; 0: never (A35)."""
    equalise_every_actions: int = Field(default=0, ge=0)
    """Actions between them, in place of `equalise_every`; 0: episodes are counted (E39)."""
    equalise_keep: Probability = 0.7
    """Eq 3.5: r <- keep r + (1 - keep) Q."""
    protect_terminal: bool = False
    """Leave the -1 of terminal samples unchanged (E24)."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        _at_most(self, "memory", "threshold_percent", "threshold_max_percent")
        if 0 < self.capacity_max < self.capacity:
            raise ValueError(
                f"memory.capacity_max ({self.capacity_max}) must be 0 or at least "
                f"memory.capacity ({self.capacity})"
            )
        return self


class LearningConfig(Section):
    """The training step, the fitting phase and the target rule (A25, A26, A36)."""

    mode: Literal["synchronous", "asynchronous"] = "synchronous"
    """Whether the robot waits while the network trains."""
    max_lag_episodes: int = Field(default=50, ge=1, le=100_000)
    """Asynchronous: the robot waits when the learner is this many episodes behind."""
    batch_size: int = Field(default=128, ge=1, le=4096)
    mini_batches_per_episode: int = Field(default=1, ge=0, le=1000)
    learning_rate: float = Field(default=0.00025, gt=0.0, le=1.0)
    rmsprop_alpha: float = Field(default=0.9, ge=0.0, lt=1.0)
    """E30."""
    rmsprop_epsilon: float = Field(default=1e-6, gt=0.0, le=1.0)
    """E30."""
    fit_every: int = Field(default=100, ge=0)
    """Episodes between fitting phases; 0: never."""
    fit_every_actions: int = Field(default=0, ge=0)
    """Actions between them, in place of `fit_every`; 0: episodes are counted (E39)."""
    fit_after_fill: bool = False
    """A fitting phase at the first episode, too: the robot learns from the samples that filled the
    memory before it drives much with an untrained network."""
    fit_epochs: int = Field(default=3, ge=1, le=1000)
    augmentation: Literal["none", "mirror"] = "none"
    """mirror: half of all samples, by chance, are mirrored for training, left and right
    exchanged. What is learnt in one direction of a corridor then helps in the other."""
    target_rule: Literal["bump", "episode"] = "episode"
    """Copy train to target after episodes with a bump (thesis, A26) or after every one (E15)."""
    target_average: bool = False
    """Copy the mean of the weights after each step of a fitting phase's last epoch, or of the
    episode's mini-batches. It drives more steadily than the newest weights. With target_rule
    'episode' only."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.target_average and self.target_rule != "episode":
            raise ValueError(
                f"learning.target_average needs learning.target_rule 'episode', got "
                f"{self.target_rule!r}"
            )
        return self


class Numerics(Section):
    """Arithmetic of one role. Equal settings give equal bits."""

    device: Literal["cpu", "cuda", "auto"] = "cpu"
    """auto: a GPU if there is one, found when the run first starts, then fixed in its folder."""
    engine: Literal["torch", "openvino", "auto"] = "torch"
    """What predicts on a CPU. auto: the faster installed one, measured when the run first starts,
    then fixed in its folder. Training always uses torch."""
    threads: int = Field(default=1, ge=0, le=256)
    """0: chosen when the run first starts, then fixed in its folder."""
    precision: Literal["float32", "bfloat16", "auto"] = "float32"
    """bfloat16: for convolutions when predicting, and for their backward pass when training (it is
    too inexact for the forward pass). auto: the faster one, measured when the run first starts,
    then fixed in its folder."""
    batch: int = Field(default=32, ge=1, le=4096)
    """Images per pass. When predicting, torch pads to it, so that results do not depend on how
    many images there are. Those of openvino never do: it takes passes of any size up to 32."""
    cuda_batch: int = Field(default=2048, ge=1, le=65536)
    """Images per pass on a GPU."""

    @property
    def settled(self) -> bool:
        """Whether nothing is left to be chosen."""
        return self.threads > 0 and "auto" not in (self.device, self.engine, self.precision)

    @property
    def images_per_pass(self) -> int:
        """`batch` or `cuda_batch`, by the device."""
        return self.cuda_batch if self.device == "cuda" else self.batch


class ActorNumerics(Numerics):
    """One observation at a time."""

    batch: int = Field(default=1, ge=1, le=4096)
    """Observations per pass."""
    cuda_batch: int = Field(default=1, ge=1, le=65536)
    """Observations per pass on a GPU."""


class LearnerNumerics(Numerics):
    """Training: each thread takes a share of the mini-batch, and computes it in parts."""

    engine: Literal["torch"] = "torch"
    batch: int = Field(default=8, ge=1, le=4096)
    """Images per part. Small parts stay in the processor's caches."""


class NumericsConfig(Section):
    """Numerics by role; the single-process loop applies the same ones per role."""

    actor: ActorNumerics = ActorNumerics()
    replay: Numerics = Numerics()
    learner: LearnerNumerics = LearnerNumerics()


DRIVER_ONLY = ("id", "kind", "hardware", "robotino", "ros2")
"""Keys of `robot` that nobody but its driver uses: another robot may take part in a run."""


class Config(Section):
    """The whole tree."""

    run: RunConfig = RunConfig()
    bus: BusConfig = BusConfig()
    robot: RobotConfig = RobotConfig()
    episode: EpisodeConfig = EpisodeConfig()
    reward: RewardConfig = RewardConfig()
    policy: PolicyConfig = PolicyConfig()
    network: NetworkConfig = NetworkConfig()
    memory: MemoryConfig = MemoryConfig()
    learning: LearningConfig = LearningConfig()
    numerics: NumericsConfig = NumericsConfig()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        filters, name = self.network.filters, self.memory.strategy
        ours = STRATEGIES.get(name)
        of_maps = ours and ours.describes and self.memory.descriptor in ("maps", "first-maps")
        if of_maps and filters % 16 and 16 % filters:
            raise ValueError(
                f"memory.strategy '{name}' needs network.filters to divide 16 or to be a multiple "
                f"of 16, got {filters}"
            )
        return self

    @property
    def max_distance_m(self) -> float:
        """Farthest reachable point within the horizon: v * dt * horizon (Eq 3.2, E31)."""
        return self.robot.step_m * self.episode.horizon

    def to_dict(self) -> dict[str, Any]:
        """The tree as plain nested dictionaries."""
        return self.model_dump(mode="json")

    def binding(self) -> dict[str, Any]:
        """The part of the tree that must agree between services that work together.

        Where the router is, how long the run goes on, which robots an actor serves, which robot a
        driver drives and how it reaches it may differ.
        """
        tree = self.to_dict()
        del tree["bus"], tree["run"]["episodes"], tree["run"]["robots"]
        for key in DRIVER_ONLY:
            del tree["robot"][key]
        return tree

    def fingerprint(self) -> str:
        """16 hex digits over `binding`."""
        text = json.dumps(self.binding(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:16]
