"""Every message of the protocol, typed, one class per fact or request.

The same objects are the in-process types. On the wire each is a msgpack map of its fields plus
``"v"`` (protocol version) and ``"t"`` (class name), see `shared.codec`; who sends what to whom
stands in `shared.keys`. Arrays travel as raw little-endian bytes whose size is checked here.
"""

from __future__ import annotations

import hashlib
from typing import Annotated, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from shared.columns import CHANGES, EPISODE
from shared.facts import ACTION_COUNT, ACTIONS, CHOOSERS, IMAGE_BYTES, IMAGE_SHAPE, NAME, Chooser
from shared.facts import PROTOCOL_VERSION as PROTOCOL_VERSION

MAX_EPISODE_SAMPLES = 5000
"""More samples than this in one episode are refused, whatever the configuration says."""

ImageArray = npt.NDArray[np.uint8]
Life = Annotated[str, Field(pattern=r"^[0-9a-f]{12}$")]
"""12 hex digits, drawn at process start: no two processes have the same."""
MAX_EARLIER = 8
Lives = Annotated[tuple[Life, ...], Field(max_length=MAX_EARLIER)]
Ident = Annotated[str, Field(pattern=NAME.pattern)]
Count = Annotated[int, Field(ge=0, lt=2**63)]
Few = Annotated[int, Field(ge=0, lt=2**31)]
"""Counted per submission and summed up for ever: bounded so that no sender can overflow a sum."""
Sequence = Annotated[int, Field(ge=0, lt=2**32)]
Metres = Annotated[float, Field(ge=-1e6, le=1e6)]
Radians = Annotated[float, Field(ge=-1e6, le=1e6)]
Seconds = Annotated[float, Field(ge=0.0, le=1e10)]
ActionNumber = Annotated[int, Field(ge=0, lt=ACTION_COUNT)]
ActionValues = Annotated[tuple[float, ...], Field(min_length=ACTION_COUNT, max_length=ACTION_COUNT)]
"""One prediction for each action, in the order of `facts.ACTIONS`."""
Image = Annotated[bytes, Field(min_length=IMAGE_BYTES, max_length=IMAGE_BYTES)]
"""uint8 [50, 75] grey, row by row from the top left."""
Channel = Annotated[int, Field(ge=0, le=255)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Hash = Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]

Version = Annotated[int, Field(ge=0, lt=2**32)]
"""Of the target network: each sample keeps the one that chose its action, as uint32."""
Stored = Annotated[int, Field(ge=0, lt=2**32)]
"""What samples keep as uint32, and numbers of actions."""
Text = Annotated[str, AfterValidator(lambda text: "".join(map(_shown, text)))]
"""Free text. Whatever a terminal would not show as it is, escape codes among it, is replaced."""
Reason = Annotated[Text, Field(max_length=1000)]
Lineage = Hash
NO_LINEAGE = "0" * 16
"""The lineage of a memory without submissions."""
MAX_PLACE = 1e6
"""Metres or radians from the origin: beyond it no number of a pose makes sense."""
MAX_FLOAT32 = 3.5e38

MAX_FAULTS = 24
"""Kinds of faults that a driver tells of: the most frequent ones."""

Interruption = Literal["", "pause", "estop", "late", "stop", "restart", "world", "blocked", "moved"]
"""Why the robot did not simply execute the last action; empty: it did. blocked: a real robot was
not fit to drive, `RobotState.reason` said why."""
Motion = Literal["", "turn-left", "turn-right", "forward", "back"]
"""A motion that is none of the actions: turning on the spot, or creeping to another place."""


def _shown(character: str) -> str:
    return character if character.isprintable() else " " if character.isspace() else "?"


class Message(BaseModel):
    """Base of all messages: frozen, strictly typed, unknown fields refused, no NaN."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


def image_array(image: bytes) -> ImageArray:
    """The bytes of an image as a read-only uint8 [50, 75] view."""
    return np.frombuffer(image, np.uint8).reshape(IMAGE_SHAPE)


# ---------------------------------------------------------------- robot <-> actor


class Observation(Message):
    """What the robot perceives after action `sequence - 1`, while it waits for the next.

    Driver to actor and monitor. In lockstep it is sent again until answered.
    """

    robot: Ident
    life: Life
    earlier: Lives = ()
    """Lives that this one continues after clean stops, newest first. `sequence` goes on."""
    sequence: Sequence
    """Grows by one per executed action. The action that answers it has the same number."""
    attempt: Count = 0
    """Counts fresh observations of one sequence: after a hold, a late action or an interruption."""
    action: ActionNumber | None = None
    """The action that was executed last, between `sequence - 1` and this; None: there was none."""
    actor_life: Life | Literal[""] = ""
    """Life of the actor that had sent it (`Action.actor_life`)."""
    image: Image
    x_m: Metres
    y_m: Metres
    heading_rad: Radians
    bump: bool
    """Contact at any time during the last action (E11). A recovery, if any, is over."""
    interruption: Interruption = ""
    world: Ident
    period_s: Annotated[float, Field(gt=0.0, le=60.0)]
    stamp_s: Seconds
    """Simulated time in lockstep, the driver's monotonic clock in realtime."""
    laps_left: Few = 0
    """Laps completed anticlockwise since the life began; 0 in worlds without laps."""
    laps_right: Few = 0
    """Laps completed clockwise."""


class Action(Message):
    """The answer to one observation. Actor to driver."""

    robot: Ident
    actor_life: Life
    robot_life: Life
    sequence: Sequence
    """Number of the observation answered. The driver ignores an answer to any other."""
    attempt: Count = 0
    """Attempt of the observation answered."""
    action: ActionNumber | None = Field(
        description=", ".join(f"{number} {action.name}" for number, action in enumerate(ACTIONS))
        + " (A21); None: hold still for one period."
    )
    motion: Motion = ""
    """Move like this for one period. `action` is None then. A driver that cannot do it holds still.
    It counts as no action: `sequence` stays, and the next observation says "moved"."""
    by: Chooser
    values: ActionValues
    """Clipped predictions Q(s, a) of all actions, for the monitor."""
    weights_version: Count
    episode: Count = 0
    """Counted episodes of the robot so far; 0 while the memory fills. Changes of the world wait for
    it (`WorldChange.at_episode`)."""
    filling: bool = False
    """The action was chosen to fill the memory (A13)."""
    fills: Count = 0
    """Fill submissions of the robot so far. Anyone can repeat the choice, which depends on seed,
    policy, values, `step`, and on this if `filling`, else on `episode`."""
    step: Count = 0
    """Steps in the robot's open episode before this one."""

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if self.motion and self.action is not None:
            raise ValueError(f"motion {self.motion!r}: expected no action beside it")
        return self


class Takeover(Message):
    """What a person wants of a robot that learns, said again and again. Operator to actor.

    The first one takes the robot over: from then on it moves only while wishes for an action keep
    coming. It stays so, also in silence, until it is given back.
    """

    robot: Ident
    life: Life
    """Of the process by which the person drives. One drives at a time."""
    number: Count
    """Grows with every message of a life; one that comes late does nothing."""
    action: ActionNumber | None
    """None: stand."""
    give_back: bool = False
    """The network drives again."""


MAX_HALTS, MAX_RELEASED = 64, 256
"""Halts in force, and released ones that are remembered: the newest."""
HaltKind = Literal["estop", "pause"]
DriverState = Literal["waiting", "driving", "recovering", "blocked", "paused", "estop", "stopped"]


class Halt(Message):
    """Robots are to stand until this is released."""

    number: Count
    """No two are alike: the sender's clock in nanoseconds since 1970."""
    kind: HaltKind
    """estop: an emergency stop, ended by `clear`. pause: ended by `resume`."""
    robot: Ident | Literal[""] = ""
    """Which robot; empty: every robot of the run."""


class Released(Message):
    """A halt that was released, for one robot or for all."""

    number: Count
    robot: Ident | Literal[""] = ""


class Halts(Message):
    """Halts to take over, as far as they are not known; without any, it only asks.

    An operator, or a service that knows of halts in force, to every driver and service. Every life
    answers with `Standing`: ask with the target ALL and no consolidation.
    """

    halts: Annotated[tuple[Halt, ...], Field(max_length=MAX_HALTS)] = ()


class Deadline(Message):
    """Which life is meant, and until when by its own clock (`Standing.clock_s`)."""

    life: Life
    until_s: Seconds


class Release(Message):
    """Ends halts. Operator to every driver and service; every life answers with `Standing`.

    It names what it ends and whom it means, so that one that comes late, or to another process,
    does nothing.
    """

    numbers: Annotated[tuple[Count, ...], Field(min_length=1, max_length=MAX_HALTS)]
    robot: Ident | Literal[""] = ""
    """For which robot; empty: for every robot of the run."""
    deadlines: Annotated[tuple[Deadline, ...], Field(max_length=256)]
    """At most two seconds after the `Standing` that each life gave last."""


class Standing(Message):
    """What one life knows of halts, and whether its robot stands. Everyone to operator."""

    service: Ident
    id: Ident
    life: Life
    clock_s: Seconds
    """Its clock, for a release that it is to carry out. It goes on while the machine sleeps."""
    state: DriverState | Literal[""] = ""
    """Of a driver's robot; empty: a service without a robot."""
    stands: bool = False
    """The robot has been told to stand still, and no action moves it while a halt holds it."""
    halts: Annotated[tuple[Halt, ...], Field(max_length=MAX_HALTS)]
    """Those in force as far as it knows; of a driver those that hold its robot."""
    released: Annotated[tuple[Released, ...], Field(max_length=MAX_RELEASED)] = ()
    problem: Annotated[Text, Field(max_length=300)] = ""
    """Why the halts could not be kept on disk; a restart would forget them."""


class Fault(Message):
    """One kind of fault between a driver and its robot."""

    name: Text
    """Which part failed and how: `camera: timeout`."""
    count: Count


class RobotState(Message):
    """Heartbeat of a driver. Driver to operator and watcher."""

    robot: Ident
    life: Life
    state: DriverState
    """blocked: a real robot is not fit to drive. It goes on by itself once it is."""
    sequence: Sequence
    x_m: Metres
    y_m: Metres
    heading_rad: Radians
    world: Ident
    bumps: Count
    recoveries: Count
    deadman_stops: Count
    clamped: Count
    late_actions: Count
    refused_actions: Count
    resent_observations: Count
    undecodable: Count
    busy: Count
    """Requests answered with "busy", and messages of more senders than are kept apart."""
    laps_left: Few
    laps_right: Few
    pending_changes: Count
    """Changes of the world that wait for their episode."""
    refused_changes: Count
    """Changes of the world that were refused, at once or when they were due."""
    blocks: Count = 0
    """How often the robot was found unfit to drive."""
    reason: Annotated[Text, Field(max_length=200)] = ""
    """Why it is not fit to drive now; empty when it is."""
    faults: Annotated[tuple[Fault, ...], Field(max_length=MAX_FAULTS)] = ()
    """What went wrong between driver and robot so far, the most frequent first."""


class Box(Message):
    """A box on the floor of a simulated world, in metres and degrees."""

    name: Ident
    x_m: Metres
    """Place of its middle."""
    y_m: Metres
    heading_deg: Annotated[float, Field(ge=-1e6, le=1e6)] = 0.0
    """Direction along which `length_m` is measured."""
    length_m: Metres
    width_m: Metres
    height_m: Metres
    rgb: Annotated[tuple[Channel, Channel, Channel], Field(strict=False)]
    """Red, green, blue, 0..255."""


class WorldChange(Message):
    """A change of a simulated robot's world. Operator to driver, answered by `WorldChanged`.

    Only what its kind needs is set: `world` (and `start`), `box`, or `name`.
    """

    id: Annotated[str, Field(pattern=r"^([0-9a-f]{12})?$")] = ""
    """Drawn by the sender. A change that is sent again with the same id is carried out once. If
    empty, each one counts. withdraw: the id of the waiting change that is not to come."""
    kind: Literal["switch", "place", "remove", "withdraw", "list"]
    """list only asks for the answer."""
    at_episode: Count = 0
    """Carried out in place of the first action whose `Action.episode` is at least this; 0: now."""
    world: Ident | None = None
    """switch: the world that the robot drives in from then on."""
    start: Few = 0
    """switch: which of that world's start poses, from 0."""
    box: Box | None = None
    """place: the obstacle."""
    name: Ident | None = None
    """remove: name of the obstacle."""

    @model_validator(mode="after")
    def _fits_kind(self) -> Self:
        given = {key for key in ("world", "box", "name") if getattr(self, key) is not None}
        needed = {"switch": {"world"}, "place": {"box"}, "remove": {"name"}}.get(self.kind, set())
        if given != needed:
            expected = ", ".join(needed) or "none of world, box, name"
            got = ", ".join(sorted(given)) or "neither"
            raise ValueError(f"{self.kind}: expected {expected} and no other, got {got}")
        if self.kind == "withdraw" and not self.id:
            raise ValueError("withdraw: expected the id of a waiting change")
        return self


class WorldChanged(Message):
    """What became of a `WorldChange`, and the world as it is now. Driver to operator."""

    accepted: bool
    """The change was carried out, or is kept until its episode."""
    reason: Text = ""
    """Why it was refused; empty if accepted."""
    world: Text
    """The robot's world; empty if it cannot be changed."""
    obstacles: tuple[Ident, ...]
    """Names of its obstacles."""
    pending: Count
    """Changes that wait for their episode."""
    waiting: Annotated[tuple[WorldChange, ...], Field(max_length=128)] = ()
    """withdraw, list: these changes, in the order in which they are due."""


# ---------------------------------------------------------------- actor -> replay


class Episode(Message):
    """The samples of one episode, to be stored.

    Actor to replay, answered by `EpisodeAck`. Its identity is (robot, life, number). It is stored
    once, however often it is sent.
    """

    robot: Ident
    life: Life
    """Life of the actor process that gathered it."""
    number: Count
    """Counts this actor life's submissions for this robot from 0."""
    fill: bool
    """Gathered to fill the memory, and not counted as an episode (E9)."""
    ended: Literal["bump", "full", "interrupted"]
    bump: bool
    weights_version: Version
    """Version that predicted the rewards. Replay uses it or a newer one for this turn."""
    fitness: Few
    """Actions without a bump including carried-over ones, at most 500 (A37, E10)."""
    actions: Few
    """Actions executed since the previous episode of this robot ended."""
    dropped_samples: Few
    """Samples lost to interruptions and restarts since the previous submission."""
    dropped_episodes: Few
    """Open episodes lost with an actor or driver since the previous submission."""
    worlds: Annotated[tuple[Ident, ...], Field(min_length=1, max_length=64)]
    """The names that `sample_worlds` refers to."""
    images: bytes
    """uint8 [n, 50, 75]."""
    sample_actions: bytes
    """uint8 [n], numbers of `facts.ACTIONS`."""
    sample_rewards: bytes
    """float32 [n], -1..1."""
    sample_steps: bytes
    """uint32 [n]: step of the robot's episode in which each was gathered."""
    sample_episodes: bytes
    """uint32 [n]: the robot's own episode count when each was gathered (carried ones: one less)."""
    sample_versions: bytes
    """uint32 [n]: weights version that chose each action, at most `weights_version`."""
    sample_worlds: bytes
    """uint8 [n]: index into `worlds`."""
    sample_by: bytes
    """uint8 [n], who chose each action: index into `facts.CHOOSERS`."""
    positions: bytes
    """float32 [n, 3]: x_m, y_m, heading_rad at each sample."""
    robot_life: Life
    last_sequence: Stored
    """Driver sequence of the newest action whose sample is in here or counted as dropped. All
    samples are of actions after the `last_sequence` of the same `robot_life` before."""
    laps_left: Few = 0
    laps_right: Few = 0
    """Laps completed while the samples were gathered."""

    @model_validator(mode="after")
    def _sizes(self) -> Self:
        n = self.count
        if not 1 <= n <= MAX_EPISODE_SAMPLES:
            raise ValueError(f"an episode has 1..{MAX_EPISODE_SAMPLES} samples, got {n}")
        EPISODE.check(self, n)
        if self.bump != (self.ended == "bump"):
            raise ValueError(f"bump is {self.bump}, but the episode ended {self.ended!r}")
        if (most := max(self.sample_actions)) >= ACTION_COUNT:
            raise ValueError(f"sample_actions: expected 0..{ACTION_COUNT - 1}, got {most}")
        if max(self.sample_worlds) >= len(self.worlds):
            raise ValueError("sample_worlds: index outside worlds")
        if (most := max(self.sample_by)) >= len(CHOOSERS):
            raise ValueError(f"sample_by: expected 0..{len(CHOOSERS) - 1}, got {most}")
        rewards = np.frombuffer(self.sample_rewards, "<f4")
        if not bool(np.all(np.abs(rewards) <= 1.0)):  # also false for NaN
            raise ValueError("sample_rewards: expected -1..1")
        if not bool(np.all(np.abs(np.frombuffer(self.positions, "<f4")) <= MAX_PLACE)):
            raise ValueError(f"positions: expected numbers within {MAX_PLACE:.0f}")
        return self

    @property
    def count(self) -> int:
        """Number of samples n."""
        return len(self.sample_actions)

    @property
    def digest(self) -> str:
        """16 hex digits over what was seen, done and rewarded: equal runs have equal digests."""
        parts = (self.images, self.sample_actions, self.sample_rewards, self.positions)
        return hashlib.sha256(b"".join(parts)).hexdigest()[:16]


class EpisodeAck(Message):
    """The episode is on disk, exactly once. Replay to actor. It says nothing about training."""

    accepted: bool
    reason: Reason = ""
    """Why it was refused for good, after its kind and a colon; empty if accepted."""
    duplicate: bool = False
    commit: Count = 0
    """Number of the submission among all, those of the fill included."""
    episode: Count = 0
    """The global episode number; for fill submissions that of the latest counted episode."""
    stored: Count = 0
    """Samples stored. Only the last fill submission is cut at the capacity (A13)."""
    progress: RobotProgress | None = None


class ProgressRequest(Message):
    """Asks where this robot was. Actor to replay, answered by `RobotProgress`."""

    robot: Ident


class RobotProgress(Message):
    """What one robot's next episode must know of the stored ones. Replay to actor."""

    robot: Ident
    filling: bool
    """The memory is still being filled (A13)."""
    fill_missing: Count
    robot_fills: Stored
    """Fill submissions of this robot so far."""
    robot_episodes: Stored
    """Counted episodes of this robot so far."""
    episode: Count
    """Newest global episode number committed."""
    robot_life: Annotated[str, Field(pattern=r"^([0-9a-f]{12})?$")]
    """Driver life of the robot's newest stored sample; empty if none."""
    last_sequence: Annotated[int, Field(ge=-1, lt=2**32)]
    """Driver sequence of that sample; -1 if none."""


# ---------------------------------------------------------------- replay -> learner


class Told(Message):
    """One number that a retention strategy reports."""

    name: Annotated[Text, Field(max_length=64)]
    value: Count


class ReplayState(Message):
    """Heartbeat of replay with its newest numbers. Replay to all."""

    id: Ident
    life: Life
    change: Count
    """Newest change number n."""
    commit: Count
    episode: Count
    """Newest counted episode committed to disk."""
    turn: Count
    """Newest episode whose discard and equalisation are done. The learner may train on it."""
    turn_change: Count
    """Change number the learner must reach before training on `turn`."""
    lineage: Lineage
    """Of the memory as of `turn_change`: see `Turn`."""
    size: Count
    capacity: Count
    filling: bool
    by_action: Annotated[tuple[Count, ...], Field(min_length=ACTION_COUNT, max_length=ACTION_COUNT)]
    retention: Annotated[tuple[Told, ...], Field(max_length=64)] = ()
    """What the retention strategy reports."""
    weights_version: Version
    """Version that the memory is maintained with."""
    known_version: Version
    """Newest version that replay has or knows from an episode. A learner that has lost its
    checkpoint goes on above it."""
    activity: Literal["idle", "committing", "descriptors", "equalising", "discarding", "waiting"]
    progress: Fraction = 1.0
    fitness_mean_100: Annotated[float, Field(ge=0.0, le=2.0**31)]
    bumps: Count
    laps_left: Count
    laps_right: Count
    actions: Count
    dropped_samples: Count
    dropped_episodes: Count
    duplicates: Count
    refused: Count
    undecodable: Count


class TurnsRequest(Message):
    """Asks which episodes after `since` are ready for training. Learner to replay."""

    since: Count
    limit: Annotated[int, Field(ge=1, le=1000)] = 100


class Turn(Message):
    """One counted episode ready for training."""

    episode: Count
    change: Count
    bump: bool
    actions: Count
    """Actions of this episode."""
    total_actions: Count
    """Actions of counted episodes until then, those of this one included."""
    samples: Count
    lineage: Lineage
    """Of the memory as of `change`: a hash over all submissions until then. Two memories in which
    an episode has another lineage have different histories."""


class Turns(Message):
    """Answer to `TurnsRequest`, in order of episode, without gaps."""

    turns: Annotated[tuple[Turn, ...], Field(max_length=1000)]


class ChangesRequest(Message):
    """Asks for the changes after `since` up to `upto`. Learner to replay, many replies."""

    since: Count
    upto: Count
    lineage: Lineage
    """That of the mirror at `since`."""


class SnapshotRequest(Message):
    """Asks for the whole memory as of the newest turn. Learner to replay, many replies."""


class Change(Message):
    """One numbered change of the memory, or a part of one, in the order it was applied."""

    number: Count
    """Change number. Parts of one change share it and come in order."""
    last: bool
    """Final part of this change."""
    kind: Literal["append", "discard", "rewards"]
    ids: bytes
    """uint64 [n] insertion numbers, ascending: appended, removed, or given new rewards."""
    images: bytes = b""
    """append: uint8 [n, 50, 75]."""
    actions: bytes = b""
    """append: uint8 [n]."""
    rewards: bytes = b""
    """append, rewards: float32 [n]."""

    @model_validator(mode="after")
    def _sizes(self) -> Self:
        if len(self.ids) % 8:
            raise ValueError(f"ids: expected a multiple of 8 bytes, got {len(self.ids)}")
        CHANGES[self.kind].check(self, self.count, f"{self.kind}.")
        for name in CHANGES["append"].names - CHANGES[self.kind].names:
            if getattr(self, name):
                raise ValueError(f"{self.kind}.{name}: expected no bytes")
        return self

    @property
    def count(self) -> int:
        """Number of samples n."""
        return len(self.ids) // 8


class FeedEnd(Message):
    """Last reply to `ChangesRequest` and `SnapshotRequest`. Without it the transfer broke."""

    change: Count
    """The mirror now has exactly the changes up to this one."""
    rows: Count
    """Rows sent before, over all parts, to be compared with what arrived."""
    messages: Count
    """Parts sent before."""
    lineage: Lineage
    """Of the memory as of `change`."""
    gone: bool = False
    """The changes asked for are no longer kept, or the mirror has another lineage: take a
    snapshot."""


class MiniBatchRequest(Message):
    """Asks for a mini-batch, for foreign learners without a mirror. One `Change` comes back."""

    size: Annotated[int, Field(ge=1, le=4096)]
    key: Count
    """The same key gives the same mini-batch of the same memory."""


# ---------------------------------------------------------------- learner -> actor, replay


class LearnerState(Message):
    """Heartbeat of the learner, and its announcement of finished turns. Learner to all."""

    id: Ident
    life: Life
    episode: Count
    """Newest finished turn: trained, target rule applied, checkpoint on disk."""
    weights_version: Version
    """Newest target version; fetch it by `WeightsRequest`."""
    weights_hash: Hash
    activity: Literal["waiting", "synchronising", "training", "fitting", "checkpoint"]
    fit_epoch: Count = 0
    fit_batch: Count = 0
    fit_batches: Count = 0
    """Mini-batches of the running fitting phase, all epochs."""
    loss: Annotated[float, Field(ge=0.0, le=MAX_FLOAT32)] | None
    """Mean loss of the newest turn trained."""
    train_steps: Count
    fits: Count
    target_age: Count
    """Turns since the target was last copied."""
    resyncs: Count
    undecodable: Count


class WeightsRequest(Message):
    """Asks for the newest target network. Actor, replay, anyone to learner."""


class Weights(Message):
    """One version of the target network, in parts of about 1 MB. The learner's answer."""

    version: Version
    hash: Hash
    """First 16 hex digits of SHA-256 over all bytes."""
    part: Annotated[int, Field(ge=0, lt=64)]
    parts: Annotated[int, Field(ge=1, le=64)]
    data: Annotated[bytes, Field(max_length=4 * 1024 * 1024)]
    """safetensors; concatenate the parts in order."""


# ---------------------------------------------------------------- every service


class ActorState(Message):
    """Heartbeat of the actor, one per robot served. Actor to operator and watcher."""

    id: Ident
    life: Life
    robot: Ident
    phase: Literal["waiting", "filling", "driving", "handing-over", "training", "person", "stopped"]
    """person: the robot waits for a person, or is driven by one."""
    taken_over: bool = False
    """By a person; it stands unless they say otherwise, until they give it back."""
    person: Life | Literal[""] = ""
    """`Takeover.life` of the person heard last."""
    person_silent_s: Seconds = 0.0
    """How long nothing was heard of them, while it is taken over."""
    human_actions: Count = 0
    """Actions that persons chose."""
    refused_takeovers: Count = 0
    """Messages of another person than the one who drives, or out of order."""
    step: Count
    """Samples in the open episode."""
    robot_episode: Count
    weights_version: Count
    actions: Count
    actions_per_s: float
    stale_observations: Count
    rival_observations: Count
    """Observations of another life of the robot while the one served was there."""
    foreign_actions: Count
    """Actions that the robot executed, but another actor had sent."""
    refused_weights: Count
    """Target networks that were not taken: of a wrong shape, not finite, or damaged."""
    refused_episodes: Count
    """Episodes that replay refused for good; they are lost."""
    dropped_samples: Count
    dropped_episodes: Count
    resent_episodes: Count
    undecodable: Count
    busy: Count
    values: ActionValues


class Ping(Message):
    """Asks a service who it is. Anyone to any service, answered by `ServiceReply`."""


class StopService(Message):
    """Asks a service to stop cleanly. Operator to any service, answered by `ServiceReply`."""


class ServiceReply(Message):
    """Who a service is. Every life that has the role answers."""

    service: Ident
    id: Ident
    life: Life
    host: Annotated[Text, Field(max_length=255)]
    pid: Count
    protocol: Count
    version: Annotated[Text, Field(max_length=64)]
    config: Hash
    uptime_s: Seconds
    rivals: Count
    """How often another life in the same role was met."""


class Refusal(Message):
    """The content of an error reply to any request."""

    final: bool
    """The same request will be refused again; otherwise it may be sent again after a moment."""
    reason: Annotated[Text, Field(max_length=300)]


EpisodeAck.model_rebuild()
