"""What must hold in a run whatever happens to its processes, judged from outside (no bus, no disk).

`Checker` reads what the run publishes, in the order in which it arrives, and the submissions that
replay has on disk at the end. Every action says how many of its robot's episodes its actor knows to
be stored, and a heartbeat of replay says how many submissions are on disk: nothing of that may be
missing later. An acknowledgement whose actor was killed before its next action is not seen; what
was acknowledged then is only known to be on disk because numbers have no gaps.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from services.replay.numbering import lineage_after
from shared.messages import (
    NO_LINEAGE,
    Action,
    ActorState,
    HaltKind,
    LearnerState,
    Message,
    Observation,
    ReplayState,
    RobotState,
)

UNDER_WAY = 2
"""Actions of which a driver may tell after its first message under a halt: they were executed
before it heard of it, and what tells of them was under way."""
Record = Mapping[str, Any]
"""One submission, as `Storage.records` gives it."""


class Checker:
    """Collects violations. Messages and orders must come in the order in which they happened."""

    def __init__(self, robots: Iterable[str]) -> None:
        self.violations: list[str] = []
        self._halts: dict[str, set[HaltKind]] = {robot: set() for robot in robots}
        """Kinds of halts that were confirmed and not yet released."""
        self._shown: dict[str, RobotState] = {}
        """Newest heartbeat of each life of a driver."""
        self._lives: dict[str, str] = {}
        """Robot of each life of a driver."""
        self._sequences: dict[str, int] = {}
        """Sequence that each life showed last."""
        self._limits: dict[str, int] = {}
        """Highest sequence that a life may show while its robot is halted."""
        self._first: dict[str, str] = {}
        """The life that a life continues through clean stops, the first of them."""
        self._told: dict[str, tuple[int, int]] = defaultdict(lambda: (0, 0))
        """Counted and fill submissions that each actor's life and robot was told are stored."""
        self._highest: dict[str, int] = defaultdict(int)
        self.actions = 0
        """Executed actions that were seen."""

    # ------------------------------------------------------------ halts

    def held(self, kind: HaltKind, robots: Iterable[str]) -> None:
        """These robots were confirmed to stand: from now on none may move."""
        for robot in robots:
            self._halts[robot].add(kind)
            for life in filter(self.shows_halt, self._lives_of(robot)):
                self._limits.setdefault(life, self._sequences[life])

    def released(self, kind: HaltKind, robots: Iterable[str]) -> None:
        """A release is about to be sent."""
        for robot in robots:
            self._halts[robot].discard(kind)
            if not self._halts[robot]:
                for life in self._lives_of(robot):
                    self._limits.pop(life, None)

    def halted(self, robot: str) -> bool:
        """Whether a confirmed halt holds a robot."""
        return bool(self._halts[robot])

    def shows_halt(self, life: str) -> bool:
        """Whether a life has said last that its robot is halted."""
        return life in self._shown and self._shown[life].state in ("estop", "paused")

    def _seen(self, robot: str, life: str, sequence: int) -> None:
        """A life shows how many actions it has executed."""
        before = self._sequences.get(life)
        if self._halts[robot]:
            limit = self._limits.setdefault(life, self._allowed(robot, life, sequence))
            if sequence > limit:
                self._violated(f"{robot} (life {life}) moved under a halt: {sequence}, not {limit}")
        self.actions += max(0, sequence - (sequence if before is None else before))
        self._lives[life], self._sequences[life] = robot, sequence

    def _allowed(self, robot: str, life: str, sequence: int) -> int:
        """Highest sequence that a life may show that is first heard of under a halt."""
        if life in self._sequences:  # it was there before
            return sequence + UNDER_WAY
        # It began under the halt: anew, or where a clean stop left off.
        left_off = [self._sequences[other] for other in self._lives_of(robot)]
        return sequence if sequence in left_off else 0

    def _lives_of(self, robot: str) -> list[str]:
        return [life for life, its in self._lives.items() if its == robot]

    def _stands(self, state: RobotState) -> None:
        """Hold a heartbeat under a halt against those before."""
        kinds, before = self._halts[state.robot], self._shown.get(state.life)
        self._shown[state.life] = state
        if not kinds:
            return
        expected = "estop" if "estop" in kinds else "paused"
        if state.state == expected:
            self._limits[state.life] = min(state.sequence, self._limits[state.life])
        elif before is not None and before.state == expected and state.state != "estop":
            self._violated(f"{state.robot} (life {state.life}) says {state.state} under a halt")

    # ------------------------------------------------------------ what is published

    def hear(self, message: Message) -> None:
        """Take up one published message."""
        if isinstance(message, Observation):
            first = message.earlier[-1] if message.earlier else message.life
            self._first.setdefault(message.life, self._first.get(first, first))
            self._seen(message.robot, message.life, message.sequence)
        elif isinstance(message, RobotState):
            self._seen(message.robot, message.life, message.sequence)
            self._stands(message)
        elif isinstance(message, Action):
            self._grows(message.actor_life, message.robot, (message.episode, message.fills))
        elif isinstance(message, ReplayState):
            self._counts("submissions on disk", message.commit)
            self._none("episodes that replay refused for good", message.refused)
        elif isinstance(message, LearnerState):
            self._counts("episodes learnt", message.episode)
        elif isinstance(message, ActorState):
            self._none("episodes that an actor lost", message.refused_episodes)

    def _grows(self, life: str, robot: str, told: tuple[int, int]) -> None:
        """What one life of an actor knows to be stored never becomes less."""
        key = f"{robot}/{life}"
        if any(now < before for now, before in zip(told, self._told[key], strict=True)):
            self._violated(f"actor {life} was told of {self._told[key]} of {robot}, then of {told}")
        self._told[key] = told

    def _counts(self, what: str, count: int) -> None:
        if count < self._highest[what]:
            self._violated(f"{what}: {count} after {self._highest[what]}")
        self._highest[what] = max(count, self._highest[what])

    def _none(self, what: str, count: int) -> None:
        if count > self._highest[what]:
            self._violated(f"{what}: {count}")
        self._highest[what] = count

    def _violated(self, what: str) -> None:
        self.violations.append(what)

    # ------------------------------------------------------------ what is stored at the end

    def stored(self, records: Sequence[Record]) -> None:
        """Judge the submissions on disk, in order, once everything has ended."""
        self.violations += numbering_faults(records) + sequence_faults(records, self._first)
        if len(records) < self._highest["submissions on disk"]:
            self._violated(f"{self._highest['submissions on disk']} submissions were on disk, now "
                           f"{len(records)}")  # fmt: skip
        for key, (episodes, fills) in self._told.items():
            robot = key.partition("/")[0]
            kinds = [record["fill"] for record in records if record["robot"] == robot]
            if episodes > kinds.count(False) or fills > kinds.count(True):
                self._violated(f"lost: actor {key} was told of {episodes} and {fills} fills")


def numbering_faults(records: Sequence[Record]) -> list[str]:
    """Submissions that are there twice, gaps in any numbering, and a lineage that does not fit."""
    faults, lineage, episode, next_id = list[str](), NO_LINEAGE, 0, 1
    seen: dict[str, int] = {}
    for number, record in enumerate(records, start=1):
        commit, sender = record["commit"], f"{record['robot']}/{record['life']}"
        identity = f"{sender}/{record['number']}"
        if commit["commit"] != number or commit["first_id"] != next_id:
            faults.append(f"commit {number}: numbered {commit}, expected first id {next_id}")
        if not record["fill"]:
            episode += 1
            if commit["episode"] != episode:
                faults.append(f"commit {number}: episode {commit['episode']}, not {episode}")
        if record["number"] < seen.get(sender, 0):
            faults.append(f"doubled: {identity}")
        elif record["number"] > seen.get(sender, 0):
            faults.append(f"lost: episode {seen.get(sender, 0)} of {sender}; {identity} is there")
        lineage = lineage_after(lineage, identity, record["digest"])
        if record["lineage"] != lineage:
            faults.append(f"commit {number}: lineage {record['lineage']}, not {lineage}")
        seen[sender], next_id = record["number"] + 1, commit["first_id"] + commit["stored"]
    return faults


def sequence_faults(records: Sequence[Record], first: Mapping[str, str]) -> list[str]:
    """Actions that two samples are of; clean stops go on with the numbers of the life before."""
    faults, newest = list[str](), dict[str, int]()
    for record in records:
        chain = f"{record['robot']}/{first.get(record['robot_life'], record['robot_life'])}"
        begin = record["last_sequence"] - record["commit"]["stored"]
        if begin < newest.get(chain, -1):
            faults.append(f"doubled: actions of {chain} from {begin + 1}, stored up to "
                          f"{newest[chain]}: {record['commit']}")  # fmt: skip
        newest[chain] = max(record["last_sequence"], newest.get(chain, -1))
    return faults
