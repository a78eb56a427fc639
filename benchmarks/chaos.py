"""P14: a thousand random events over all processes of a run, and what holds all the same.

Router, replay, learner, actor and two drivers run as real processes. They are killed, frozen,
doubled, stopped and cut off, singly and all at once, while robots are stopped and released. What is
killed is started again. All the time, and at the end, `benchmarks/invariants.py` judges from
outside: no episode is lost or stored twice, and no robot moves under a halt. Besides, one process
has a role at a time, and at the end the run goes on learning and every process ends cleanly.

    python -m benchmarks.chaos [--events 1000] [--seed N] [--check]
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.chaos_events import MOVABLE, PROCESSES, RELEASES, ROBOTS, ROLES, SECOND, Event, draw
from benchmarks.cluster import Cluster, make_config
from benchmarks.frame import Bar, report, table
from benchmarks.invariants import Checker
from services.launcher.up import free_endpoint
from services.recorder.tap import Heard, Tap
from services.replay.storage import Storage
from shared.codec import decode
from shared.config import Config
from shared.errors import BadMessage, PeerMissing
from shared.halts.orders import RobotOrder, order
from shared.keys import (
    ACTION,
    ACTOR_STATE,
    LEARNER_STATE,
    OBSERVATION,
    REPLAY_STATE,
    ROBOT_STATE,
    check_sender,
)
from shared.messages import HaltKind, LearnerState

LONG = True
STREAMS = (OBSERVATION, ACTION, ROBOT_STATE, ACTOR_STATE, REPLAY_STATE, LEARNER_STATE)
PATIENCE_S, LEARNS_S, DOUBLE_S = 120.0, 240.0, 15.0


class Violation(AssertionError):
    """Something that must hold did not."""


class Chaos:
    """Lets events happen to a run, keeps its processes up, and watches. Use in a `with` block."""

    def __init__(self, config: Config, place: Path) -> None:
        self.cluster = Cluster(config, place / "run")
        self._twins = {
            False: Cluster(config, place / "run"),
            True: Cluster(config, place / "elsewhere"),
        }
        self.checker = Checker(ROBOTS)
        self.happened: deque[str] = deque(maxlen=60)
        self.counts: Counter[str] = Counter()
        self._timers: list[tuple[float, Callable[[], object]]] = []
        self._stopping: set[str] = set()
        self._frozen: set[str] = set()
        self._ended: set[str] = set()
        """Processes that are not there, and will be started again."""
        self._starts: Counter[str] = Counter()
        self._twin_s: dict[str, float] = {}
        """When a second process of a role was there last."""
        self._doubled: dict[str, float] = {}
        self.newest: LearnerState | None = None

    def __enter__(self) -> Chaos:
        self.cluster.start(*PROCESSES[:-1])
        self.cluster.start_second_driver(SECOND)
        bus = self.cluster.bus
        self._tap, self._present = Tap(bus, STREAMS), bus.inbox()
        self._present.watch("*")
        self.wait(lambda: all(map(self.up, ROLES)), "all processes are up")
        return self

    def __exit__(self, *error: object) -> None:
        for cluster in (*self._twins.values(), self.cluster):
            cluster.__exit__(None, None, None)

    # ------------------------------------------------------------ watching

    def pump(self, duration_s: float) -> None:
        """Let time pass: run timers, start again what ended, judge what is heard."""
        until_s = time.monotonic() + duration_s
        while True:
            for entry in [entry for entry in self._timers if entry[0] <= time.monotonic()]:
                self._timers.remove(entry)
                entry[1]()
            for heard in self._tap.take(min(0.02, max(duration_s, 0.0))):
                self._hear(heard)
            self._supervise()
            self._look_for_doubles()
            if self.checker.violations:
                raise Violation("; ".join(self.checker.violations))
            if time.monotonic() >= until_s:
                return

    def _hear(self, heard: Heard) -> None:
        """Judge a message; one that came under the key of another is refused, as services do it."""
        try:
            message = decode(heard.data, heard.stream.request)
            check_sender(heard.stream, heard.ident, message)
        except BadMessage as error:
            self.counts["misdelivered"] += 1
            self.happened.append(f"{heard.stream.name} of {heard.ident}: {error}")
            return
        self.newest = message if isinstance(message, LearnerState) else self.newest
        self.checker.hear(message)

    def wait(self, condition: Callable[[], object], what: str, limit_s: float = PATIENCE_S) -> None:
        """Let time pass until a condition holds. Raises Violation at the deadline."""
        deadline_s = time.monotonic() + limit_s
        while not condition():
            if time.monotonic() > deadline_s:
                raise Violation(f"not within {limit_s:.0f} s: {what}")
            self.pump(0.05)

    def up(self, name: str) -> bool:
        """Whether somebody has the role of a process."""
        return bool(self._present.lives(*ROLES[name]))

    def _supervise(self) -> None:
        for name in PROCESSES:
            code = None if name in self._ended else self.cluster.code(name)
            if code is None:
                continue
            # One that is told to stop while it is still loading ends by the signal itself.
            allowed = {0, -signal.SIGTERM} if name in self._stopping else set()
            if time.monotonic() - self._twin_s.get(name, -DOUBLE_S) < DOUBLE_S:
                allowed.add(4)
            if code not in allowed:
                raise Violation(f"{name} ended with exit code {code}")
            self._restart(name, 0.5)

    def _restart(self, name: str, after_s: float) -> None:
        def start() -> None:
            self._ended.discard(name)
            self._starts[name] += 1
            if name == f"driver-{SECOND}":
                self.cluster.start_second_driver(SECOND)
            else:
                self.cluster.start(name)

        self._ended.add(name)
        self._stopping.discard(name)
        self._frozen.discard(name)
        self._timers.append((time.monotonic() + after_s, start))

    def _look_for_doubles(self) -> None:
        now_s = time.monotonic()
        for name, role in ROLES.items():
            if len(self._present.lives(*role)) < 2:
                self._doubled.pop(name, None)
            elif now_s - self._doubled.setdefault(name, now_s) > DOUBLE_S:
                if len(peers := self.cluster.bus.peers(*role)) > 1:
                    raise Violation(f"two lives of one role for {DOUBLE_S} s: {peers}")
                del self._doubled[name]

    # ------------------------------------------------------------ what happens

    def happen(self, event: Event) -> None:
        """Let one event happen, and the pause after it pass."""
        self.counts[event.kind] += 1
        self.happened.append(f"{time.monotonic():.2f} {event}")
        if event.kind in ("kill", "router", "kill all"):
            names = PROCESSES if event.kind == "kill all" else (event.target,)
            names = ("router",) if event.kind == "router" else names
            self._kill(names, event.lasts_s if event.kind == "router" else event.restart_s)
        elif event.kind == "freeze":
            self._freeze(event.target, event.lasts_s)
        elif event.kind == "stop":
            self._stop(event.target)
        elif event.kind == "duplicate":
            self._duplicate(event.target, event.elsewhere)
        else:
            self._order(event.kind, event.target)  # type: ignore[arg-type]
        self.pump(event.pause_s)

    def _kill(self, names: Sequence[str], restart_s: float) -> None:
        for name in names:
            if name not in self._ended and self.cluster.code(name) is None:
                self.cluster.kill(name)
                self._restart(name, restart_s)

    def _freeze(self, name: str, lasts_s: float) -> None:
        if name not in self._ended and name not in self._frozen:
            self.cluster.freeze(name)
            self._frozen.add(name)
            self._timers.append((time.monotonic() + lasts_s, lambda: self._thaw(name)))

    def _thaw(self, name: str) -> None:
        if name in self._frozen:
            self._frozen.discard(name)
            self.cluster.thaw(name)

    def _stop(self, name: str) -> None:
        if name not in self._ended:
            starts = self._starts[name]
            self._stopping.add(name)
            self.cluster.signal(name, signal.SIGTERM)
            self._thaw(name)
            self.wait(lambda: name in self._ended or self._starts[name] > starts, f"{name} stops")

    def _duplicate(self, name: str, elsewhere: bool) -> None:
        """Start a role a second time: it ends with 4, unless the first is not there."""
        if elsewhere and name not in MOVABLE:
            self._thaw("router")
            self._thaw(name)
            self.wait(lambda: self._has_role(name), f"{name} is up")
        sure = self._has_role(name)
        twins, label = self._twins[elsewhere], f"{name}-twin"
        (twins.folder / f"{label}.out").unlink(missing_ok=True)
        twins.start_as(label, name.partition("-")[0], name.partition("-")[2])

        def decided() -> bool:
            self._twin_s[name] = time.monotonic()
            return twins.code(label) is not None or " is up (life " in twins.log(label)

        self.wait(decided, f"a second {name} ends or has the role")
        if twins.code(label) is None:
            if sure:
                raise Violation(f"a second {name} works beside the first: {twins.log(label)}")
            self.counts["taken over"] += 1
            self.wait(lambda: decided() and self._alone(name), f"one {name} is left")
            self.pump(1.0)
            twins.signal(label, signal.SIGTERM)
        self.wait(lambda: decided() and twins.code(label) is not None, f"a second {name} ends")
        if twins.code(label) not in ((4,) if sure else (0, 4)):
            raise Violation(f"a second {name} ended with {twins.code(label)}: {twins.log(label)}")

    def _alone(self, name: str) -> bool:
        """Whether no two processes have one role, and none that may think so is frozen."""
        return name not in self._frozen and len(self._present.lives(*ROLES[name])) < 2

    def _has_role(self, name: str) -> bool:
        """Whether the process runs, and the bus shows that it has its role."""
        gone = name in self._ended or not self._frozen.isdisjoint({name, "router"})
        return not gone and bool(self.cluster.bus.peers(*ROLES[name]))

    def _order(self, name: RobotOrder, robot: str) -> None:
        """Give an order until it is obeyed."""
        kind: HaltKind = "estop" if name in ("estop", "clear") else "pause"
        robots = [robot] if robot else ROBOTS
        number, deadline_s = time.time_ns(), time.monotonic() + PATIENCE_S
        if name in RELEASES.values():
            self._before_release([robot for robot in robots if self.checker.halted(robot)])
            self.checker.released(kind, robots)
        while not self._obeyed(name, robot, number):
            if time.monotonic() > deadline_s:
                raise Violation(f"{name} {robot!r} is not obeyed")
            self.pump(0.1)
        if name in RELEASES:
            self.pump(0.0)  # what came before the last robot was known to stand
            self.checker.held(kind, robots)

    def _obeyed(self, name: RobotOrder, robot: str, number: int) -> bool:
        until_s = time.monotonic() + 3.0

        def ended() -> bool:
            self.pump(0.0)
            return time.monotonic() > until_s

        try:
            return order(
                self.cluster.bus, name, robot, self.happened.append, number=number, ended=ended
            )
        except PeerMissing:
            return False

    def _before_release(self, robots: Sequence[str]) -> None:
        """Every driver that is there must say that it is halted, also one that began meanwhile."""

        def told() -> bool:
            lives = [life for robot in robots for life in self._present.lives("driver", robot)]
            return all(map(self.checker.shows_halt, lives))

        self.wait(told, "drivers say that they are halted")

    # ------------------------------------------------------------ the end

    def recover(self) -> None:
        """Thaw and release everything; the run must learn again, and end cleanly."""
        for name in list(self._frozen):
            self._thaw(name)
        self.wait(lambda: not self._ended and all(map(self.up, ROLES)), "all are up again")
        for name in RELEASES.values():
            self._order(name, "")
        self.wait(lambda: self.newest is not None, "the learner is heard")
        before = self.newest
        assert before is not None
        self.wait(lambda: self._learnt(before), "the run learns again", LEARNS_S)
        for name in ("driver", f"driver-{SECOND}", "actor", "replay", "learner", "router"):
            self.pump(0.0)
            self._ended.add(name)
            self.cluster.stop(name)

    def _learnt(self, before: LearnerState) -> bool:
        now = self.newest
        assert now is not None
        # A learner that was killed counts its steps from its checkpoint.
        return now.episode >= before.episode + 3 and now.train_steps > before.train_steps

    def judge_memory(self) -> int:
        """Judge what is on disk, once all have ended; the number of submissions."""
        config = self.cluster.config
        identity = f"{config.run.name}/{config.run.seed}"
        storage = Storage(self.cluster.folder / "replay", config.memory, identity)
        records = storage.records()
        storage.close()
        self.checker.stored(records)
        self.checker.violations += [f"unheard: {self._tap.lost}"] if self._tap.lost else []
        if self.checker.violations:
            raise Violation("; ".join(self.checker.violations))
        return len(records)

    def tell(self) -> str:
        """The last events, and the last words of every process."""
        logs = [f"--- {name}\n{self.cluster.log(name)}" for name in PROCESSES]
        return "\n".join([*self.happened, *logs])


def play(seed: int, events: int, run_name: str, place: Path) -> dict[str, float]:
    """Let the events of a seed happen; what was counted. Raises Violation, with all that is known.

    place: where the folders of the run are made.
    """
    start_s = time.monotonic()
    config = make_config(run_name, bus={"endpoint": free_endpoint()})
    with Chaos(config, place) as chaos:
        try:
            for number, event in enumerate(draw(seed, events), start=1):
                chaos.happen(event)
                if not number % 100:
                    print(f"{number} events, {chaos.checker.actions} actions", flush=True)
            chaos.recover()
            stored = chaos.judge_memory()
        except AssertionError as error:
            raise Violation(f"seed {seed}: {error}\n{chaos.tell()}") from error
        learnt = chaos.newest.episode if chaos.newest else 0
        return {
            "seed": seed, **{kind.replace(" ", "_"): n for kind, n in chaos.counts.items()},
            "seconds": round(time.monotonic() - start_s), "actions": chaos.checker.actions,
            "submissions": stored, "episodes_learnt": learnt,
        }  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Play and report; 1 when something did not hold."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--events", type=int, default=1000, help="how many events happen")
    parser.add_argument("--seed", type=int, default=None, help="of the events; default: drawn")
    parser.add_argument("--check", action="store_true", help="a few events: does it run at all")
    given = parser.parse_args(arguments)
    seed = random.SystemRandom().randrange(1 << 31) if given.seed is None else given.seed
    events = 20 if given.check else given.events
    print(f"seed {seed}", flush=True)
    with tempfile.TemporaryDirectory() as place:
        try:
            counted = play(seed, events, f"chaos-{os.getpid()}", Path(place))
        except Violation as error:
            print(error, flush=True)
            return 1
    bar = Bar("P14", 0, "violations", "lower", 0, 0, None, None, events, counted)
    report("Chaos", [table(["what", "count"], list(counted.items()))], [bar])
    return 0


if __name__ == "__main__":
    sys.exit(main())
