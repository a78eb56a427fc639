"""Who hangs, by what was heard at which time: without a bus and with the test's clock."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from fakes import message

from services.launcher.supervisor import ChildStatus
from services.launcher.watchdog import LONGEST_LOOK_S, START_TIMES, Watchdog
from services.launcher.watcher import Sight
from services.monitor.heartbeats import Seen, Snapshot
from shared.config import BusConfig, Config
from shared.messages import ActorState, LearnerState, ReplayState, RobotState

LIMIT_S = 30.0
NAMES = ("router", "replay", "learner", "actor", "driver")
STATES: dict[str, Any] = {
    "replay": ReplayState, "learner": LearnerState, "actor": ActorState, "driver": RobotState,
}  # fmt: skip


class Run:
    """A run whose children speak or not, looked at once a second."""

    def __init__(self, hang_s: float = LIMIT_S) -> None:
        config = Config(bus=BusConfig(hang_s=hang_s))
        self._robot = config.robot.id
        self._watchdog = Watchdog(config)
        self._now_s = 1000.0
        self._beats: dict[str, Any] = {}
        self.fields: dict[str, dict[str, Any]] = {name: {} for name in NAMES}
        """What the heartbeats of each child say, besides plain values."""
        self.commanded: frozenset[str] = frozenset()
        self.statuses = {name: ChildStatus(name, "running", 0, "") for name in NAMES}

    def after(
        self, seconds: float, *speaking: str, connected: bool = True, step_s: float = 1.0
    ) -> list[tuple[str, str]]:
        """Who was named within this time, while these speak and the others are silent."""
        named = []
        for _ in range(int(seconds / step_s)):
            self._now_s += step_s
            for name in speaking:
                self._beats[name] = message(STATES[name], **self.fields[name])
            seen = self._snapshot() if connected else Snapshot()
            sight = Sight(seen, connected, self.commanded)
            named.append(self._watchdog.look(self._now_s, sight, list(self.statuses.values())))
        return [name for name in named if name]

    def restart(self, name: str, life: str) -> None:
        """The child is another process from now on."""
        child = self.statuses[name]
        self.statuses[name] = replace(child, restarts=child.restarts + 1)
        self.fields[name]["life"] = life

    def _snapshot(self) -> Snapshot:
        seen = {name: Seen(beat, 0.0) for name, beat in self._beats.items()}
        return Snapshot(
            robots={self._robot: seen["driver"]} if "driver" in seen else {},
            actors={self._robot: seen["actor"]} if "actor" in seen else {},
            replay=seen.get("replay"),
            learner=seen.get("learner"),
        )

    def give_way(self) -> None:
        """Somebody else commands the robot from now on."""
        self.commanded = frozenset({self._robot})


ALL = ("replay", "learner", "actor", "driver")


def but(name: str) -> tuple[str, ...]:
    return tuple(each for each in ALL if each != name)


@pytest.mark.parametrize(
    ("name", "times"), [("driver", 1), ("actor", 1), ("replay", 5), ("learner", 5)]
)
def test_a_silent_child_is_named_once_when_its_patience_is_over(name: str, times: int) -> None:
    run = Run()
    assert run.after(1000, *ALL) == []
    assert run.after(times * LIMIT_S, *but(name)) == []
    assert run.after(1, *but(name)) == [(name, f"no heartbeat for {times * LIMIT_S + 1:.0f} s")]
    assert run.after(1000, *but(name)) == []


def test_a_child_that_was_not_heard_since_its_start_has_longer() -> None:
    run = Run()
    run.after(1, *ALL)
    run.restart("driver", "b" * 12)
    assert run.after(START_TIMES * LIMIT_S, *but("driver")) == []
    assert run.after(1, *but("driver")) == [("driver", "no heartbeat for 301 s")]
    run.restart("driver", "c" * 12)
    assert run.after(1, *ALL) == []
    assert run.after(LIMIT_S + 1, *but("driver")) == [("driver", "no heartbeat for 31 s")]


def test_what_still_comes_of_the_process_before_does_not_count() -> None:
    run = Run()
    run.after(1, *ALL)
    life = run.fields["driver"].get("life", "0" * 12)
    run.restart("driver", life)
    run.after(1, *ALL)
    assert run.after(START_TIMES * LIMIT_S - 1, *but("driver")) == []


def test_without_a_router_nobody_hangs_and_then_all_have_time_again() -> None:
    run = Run()
    run.after(1, *ALL)
    run.statuses.pop("router")  # a foreign one
    run.after(LIMIT_S - 1)
    assert run.after(1000, connected=False) == []
    assert run.after(LIMIT_S) == []


def test_a_router_that_answers_nobody_hangs() -> None:
    run = Run()
    assert run.after(START_TIMES * LIMIT_S - LONGEST_LOOK_S, connected=False) == []
    run.after(1, *ALL)
    assert run.after(LIMIT_S, connected=False) == []
    assert run.after(1, connected=False) == [("router", "no answer for 31 s")]


def test_time_in_which_nobody_looked_is_no_silence() -> None:
    run = Run()
    run.after(1, *ALL)
    assert run.after(1000, step_s=1000) == []
    assert run.after(LIMIT_S - LONGEST_LOOK_S) == []


def test_one_child_at_a_time_and_the_others_get_new_time() -> None:
    run = Run()
    run.after(1, *ALL)
    silent = ("replay", "learner")
    assert [name for name, _ in run.after(LIMIT_S + 1, *silent)] == ["actor"]
    assert run.after(LIMIT_S - 1, *silent) == []
    assert [name for name, _ in run.after(2, *silent)] == ["driver"]


@pytest.mark.parametrize(("state", "named"), [("driving", ["actor"]), ("estop", [])])
def test_an_actor_is_missed_only_by_a_robot_that_observes(state: str, named: list[str]) -> None:
    run = Run()
    run.fields["driver"] = {"state": state}
    hung = run.after(START_TIMES * LIMIT_S + 10, "replay", "learner", "driver")
    assert [name for name, _ in hung] == named


@pytest.mark.parametrize(("progress", "named"), [(0.5, ["replay"]), (1.0, [])])
def test_a_pass_of_replay_that_stands_still_hangs(progress: float, named: list[str]) -> None:
    run = Run()
    run.fields["replay"] = {"progress": progress}
    hung = run.after(START_TIMES * LIMIT_S + 10, *ALL)
    assert [name for name, _ in hung] == named


def test_children_that_do_not_run_and_a_limit_of_zero() -> None:
    run = Run(hang_s=0.0)
    run.after(1, *ALL)
    assert run.after(10_000) == []
    run = Run()
    run.after(1, *ALL)
    run.statuses["driver"] = replace(run.statuses["driver"], state="stopped")
    assert run.after(10_000, *but("driver")) == []


def test_an_actor_that_gave_way_is_not_missed() -> None:
    run = Run()
    assert run.after(10, *ALL) == []
    run.give_way()
    assert run.after(10 * LIMIT_S, *but("actor")) == []
