"""Changes of the world on their way through the driver: checked, kept, due, undone at the actor."""

from __future__ import annotations

from typing import Any

import msgpack
import numpy as np
import pytest
from builders import FakePredictor, make_config
from forwarding import ForwardingRobot
from hypothesis import given, settings
from hypothesis import strategies as st

from services.actor.actor import Actor
from services.robot_driver.driver import Driver
from services.robot_driver.host import Host
from services.robot_driver.robot import (
    STANDSTILL,
    ChangeableWorld,
    Felt,
    Pose,
    Robot,
    Sensed,
    Velocity,
)
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import World, load_world
from services.robot_driver.simulated.world_parts import Obstacle
from services.robot_driver.world_changes import MAX_PENDING
from shared.config import RobotConfig
from shared.messages import Box, Episode, Observation, RobotProgress, WorldChange, WorldChanged

LIFE = "a" * 12
CONFIG = make_config(robot={"id": "robot1"}, episode={"max_samples": 12, "horizon": 4})
FAST = settings(deadline=None, max_examples=40, derandomize=True)


class Figurine(Robot):
    """Moves along a line; keeps its world and boxes like a simulated robot, without seeing them."""

    def __init__(self) -> None:
        self.world = load_world("plus")
        self.obstacles: tuple[Obstacle, ...] = ()
        self.blocked = False
        """Refuse whatever is to be placed."""
        self.contacts: set[int] = set()
        self.velocity = STANDSTILL
        self.runs = 0
        self.done: list[str] = []

    def sense(self) -> Sensed:
        return Sensed(self.feel().pose, False, np.full((50, 75), self.runs % 256, np.uint8))

    def feel(self) -> Felt:
        return Felt(Pose(self.runs * 0.1, 0.0, 0.0), contact=False)

    def drive(self, velocity: Velocity) -> None:
        self.velocity = velocity

    def run(self, duration_s: float, *, stop_on_contact: bool) -> bool:
        self.runs += self.velocity.moving
        return self.velocity.moving and self.runs in self.contacts

    def now_s(self) -> float:
        return self.runs * 0.25

    def state(self) -> dict[str, float | int | str]:
        return {"runs": self.runs, "world": self.world.name}

    def restore(self, state: dict[str, Any]) -> None:
        self.runs, self.world = state["runs"], load_world(state["world"])

    def close(self) -> None:
        self.velocity = STANDSTILL

    @property
    def changeable(self) -> ChangeableWorld | None:
        return self

    def place(self, obstacle: Obstacle) -> None:
        if self.blocked:
            raise ValueError("it would overlap the robot")
        self.obstacles += (obstacle,)
        self.done.append(f"+{obstacle.name}")

    def remove(self, name: str) -> None:
        self.obstacles = tuple(o for o in self.obstacles if o.name != name)
        self.done.append(f"-{name}")

    def switch(self, world: World, start: int = 0) -> None:
        self.world, self.obstacles = world, world.obstacles
        self.done.append(f"{world.name}{start}")


class Plain(ForwardingRobot):
    """A robot without a world, as hardware is."""

    changeable = None


class Notes(Host):
    """Notes what the driver tells and keeps."""

    def __init__(self) -> None:
        self.told: list[str] = []
        self.kept: list[dict[str, Any]] = []

    def tell(self, line: str) -> None:
        self.told.append(line)

    def keep(self, kept: dict[str, Any]) -> None:
        self.kept.append(msgpack.unpackb(msgpack.packb(kept)))


def notes(driver: Driver) -> Notes:
    host = driver._host
    assert isinstance(host, Notes)
    return host


def make_driver(**robot: Any) -> tuple[Driver, Figurine]:
    config = CONFIG.model_copy(update={"robot": CONFIG.robot.model_copy(update=robot)})
    figurine = Figurine()
    return Driver(config, figurine, LIFE, Notes()), figurine


def box(name: str = "box", **given: Any) -> WorldChange:
    at = given.pop("at_episode", 0)
    plain = {"x_m": 3.8, "y_m": 1.5, "length_m": 0.5, "width_m": 0.5, "height_m": 0.5}
    plain |= {"rgb": (1, 2, 3), **given}
    return WorldChange(kind="place", at_episode=at, box=Box(name=name, **plain))  # type: ignore[arg-type]


def gone(name: str, at_episode: int = 0) -> WorldChange:
    return WorldChange(kind="remove", at_episode=at_episode, name=name)


def switch(world: str = "minus", at_episode: int = 0, **given: Any) -> WorldChange:
    return WorldChange(kind="switch", at_episode=at_episode, world=world, **given)


# ------------------------------------------------------------------------- when it happens


def test_a_switch_comes_instead_of_the_first_action_of_its_episode() -> None:
    driver, robot = make_driver()
    answer = driver.change(switch(at_episode=3, start=1))
    assert answer == WorldChanged(accepted=True, world="plus", obstacles=(), pending=1)
    assert (driver.world, driver.report(0).pending_changes) == ("plus", 1)
    for episode in (0, 2):
        assert not driver.apply_due(episode)
        driver.execute(0)
    before = driver.observe()
    assert driver.apply_due(3)
    after = driver.observe()
    assert robot.done == ["minus1"]
    assert robot.velocity == STANDSTILL
    assert (before.world, before.sequence, before.attempt) == ("plus", 2, 0)
    assert (after.world, after.sequence, after.attempt) == ("minus", 2, 1)
    assert after.interruption == "world"
    assert (driver.report(0).world, driver.report(0).pending_changes) == ("minus", 0)
    assert not driver.apply_due(3)
    driver.execute(0)
    assert driver.observe().interruption == ""


def test_a_box_is_no_interruption_but_a_fresh_look() -> None:
    driver, robot = make_driver()
    driver.change(box(at_episode=1))
    driver.change(gone("box", at_episode=2))
    for episode, attempt, names in ((1, 1, ["box"]), (2, 2, [])):
        assert driver.apply_due(episode)
        seen = driver.observe()
        assert (seen.sequence, seen.attempt, seen.interruption) == (0, attempt, "")
        assert [obstacle.name for obstacle in robot.obstacles] == names


def test_an_episode_that_was_missed_still_counts() -> None:
    driver, robot = make_driver()
    driver.change(switch(at_episode=3))
    assert driver.apply_due(7)
    assert robot.done == ["minus0"]


def test_now_means_at_once_between_actions_and_else_before_the_next() -> None:
    driver, robot = make_driver()
    assert driver.change(box("a"), at_once=True).obstacles == ("a",)
    assert (driver.attempt, driver.report(0).pending_changes) == (1, 0)
    answer = driver.change(box("b"))
    assert (answer.obstacles, answer.pending) == (("a",), 1)
    driver.change(switch(at_episode=1), at_once=True)
    # What waits for now goes along, in order; what waits for an episode does not.
    assert robot.done == ["+a", "+b"]
    assert driver.apply_due(1)
    assert robot.done == ["+a", "+b", "minus0"]


@FAST
@given(st.lists(st.integers(0, 5), max_size=12), st.lists(st.integers(0, 6), max_size=12))
def test_changes_happen_in_order_of_episode_and_then_of_arrival(
    wanted: list[int], episodes: list[int]
) -> None:
    driver, robot = make_driver()
    for i, at in enumerate(wanted):
        assert driver.change(box(f"b{i}", at_episode=at)).accepted
    left = list(enumerate(wanted))
    expected: list[str] = []
    for episode in episodes:
        due = sorted((at, i) for i, at in left if at <= episode)
        left = [(i, at) for i, at in left if at > episode]
        expected += [f"+b{i}" for _, i in due]
        assert driver.apply_due(episode) == bool(due)
        assert robot.done == expected
    assert driver.report(0).pending_changes == len(left)


# ------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("wish", "reason"),
    [
        (switch("maze"), "no world named 'maze'"),
        (switch("plus", start=3), "world 'plus': expected a start from 0 to 2, got 3"),
        (gone("box"), "there is no obstacle 'box'"),
        (gone("there", at_episode=5), "there is no obstacle 'there'"),
        (box("there"), "there is already an obstacle 'there'"),
        (box("boxes", at_episode=9), "there is already an obstacle 'boxes'"),
        (box(x_m=5.0), "obstacle 'box': expected x -4.9..4.9"),
        (box(x_m=3.8, at_episode=9), "obstacle 'box': expected x"),  # in Minus by then
        (box(length_m=0.0), "obstacle 'box': length_m: "),
        (box(heading_deg=400.0), "obstacle 'box': heading_deg: "),
        (box(height_m=3.0), "is higher than the walls"),
    ],
)
def test_what_cannot_be_is_refused_at_once_counted_and_told(wish: WorldChange, reason: str) -> None:
    driver, robot = make_driver()
    driver.change(box("there"), at_once=True)
    driver.change(gone("there", at_episode=4))
    driver.change(switch(at_episode=6))
    driver.change(box("boxes", x_m=0.0, y_m=0.0, at_episode=7))
    told = notes(driver).told
    told.clear()
    answer = driver.change(wish, at_once=True)
    assert not answer.accepted
    assert reason in answer.reason
    assert "\n" not in answer.reason
    assert (answer.world, answer.obstacles, answer.pending) == ("plus", ("there",), 3)
    assert driver.report(0).refused_changes == 1
    assert len(told) == 1
    assert answer.reason in told[0]
    assert (robot.done, driver.attempt) == (["+there"], 1)


def test_what_turns_out_impossible_when_due_is_counted_told_and_looked_at_again() -> None:
    driver, robot = make_driver()
    told = notes(driver).told
    driver.change(box(at_episode=2))
    driver.change(switch(at_episode=2))
    robot.blocked = True
    assert driver.apply_due(2)
    assert robot.done == ["minus0"]
    assert driver.report(0).refused_changes == 1
    assert told[0] == (
        "world: refused to place obstacle 'box' at (3.8, 1.5): it would overlap the robot"
    )
    answer = driver.change(box(x_m=0.0, y_m=0.0), at_once=True)
    assert (answer.accepted, answer.reason) == (False, "it would overlap the robot")


def test_a_robot_without_a_world_refuses_changes_and_names_the_configured_world() -> None:
    driver = Driver(CONFIG, Plain(Figurine()), LIFE)
    answer = driver.change(switch(), at_once=True)
    assert (answer.accepted, answer.world) == (False, "")
    assert answer.reason == "the world of this robot cannot be changed"
    assert driver.observe().world == "plus"


def test_waiting_changes_are_bounded() -> None:
    driver, _ = make_driver()
    for i in range(MAX_PENDING):
        wish = gone("box", i + 1) if i % 2 else box(at_episode=i + 1)
        assert driver.change(wish).accepted
    answer = driver.change(switch(at_episode=1))
    assert (answer.accepted, answer.pending) == (False, MAX_PENDING)
    assert answer.reason == f"{MAX_PENDING} changes wait already"


def test_a_wish_sent_again_is_carried_out_once_and_gets_the_same_answer() -> None:
    driver, robot = make_driver()
    wish = box().model_copy(update={"id": "1" * 12})
    first = driver.change(wish, at_once=True)
    assert driver.change(wish, at_once=True) == first
    assert robot.done == ["+box"]
    assert not driver.change(box(), at_once=True).accepted  # without id, or with another
    assert not driver.change(wish.model_copy(update={"id": "2" * 12}), at_once=True).accepted


# ------------------------------------------------------------------------- restarts


def test_a_restored_driver_keeps_what_waits_and_its_world() -> None:
    driver, _ = make_driver()
    driver.change(switch(), at_once=True)
    driver.change(switch("plus", at_episode=5, start=2))
    driver.change(box("b", x_m=0.0, y_m=0.0, at_episode=4))
    driver.change(switch("maze"))
    saved = msgpack.unpackb(msgpack.packb(driver.saved()))
    other, robot = make_driver()
    other.restore(saved)
    assert other.report(0) == driver.report(0).model_copy(update={"x_m": 0.0})
    assert other.observe().interruption == "world"
    assert other.apply_due(5)
    assert robot.done == ["+b", "plus2"]


def test_damaged_changes_are_refused() -> None:
    driver, _ = make_driver()
    with pytest.raises(ValueError, match="changes: "):
        driver.restore({**driver.saved(), "changes": [b"\xc1"]})


def test_world_obstacles_and_what_waits_outlive_a_killed_driver() -> None:
    driver, _ = make_driver()
    kept = notes(driver).kept
    driver.change(switch(), at_once=True)
    driver.change(box("b", x_m=0.0, y_m=0.0), at_once=True)
    driver.change(switch("maze"))
    driver.change(switch("plus", at_episode=4))
    driver.apply_due(3)
    assert len(kept) == 3  # once for each that was accepted
    other, robot = make_driver()
    other.restore_kept(kept[-1])
    assert (other.world, [o.name for o in robot.obstacles]) == ("minus", ["b"])
    assert other.observe().interruption == ""  # its new life tells enough
    assert other.apply_due(4)
    assert other.world == "plus"
    driver.apply_due(4)
    other, robot = make_driver()
    other.restore_kept(kept[-1])
    assert (other.world, other.report(0).pending_changes, robot.done) == ("plus", 0, [])


@pytest.mark.parametrize(
    "damage", [{"pending": [b"\xc1"]}, {"world": "maze"}, {"obstacles": [{"name": "a"}]}]
)
def test_a_damaged_kept_world_is_refused(damage: dict[str, Any]) -> None:
    driver, _ = make_driver()
    kept = notes(driver).kept
    driver.change(box(), at_once=True)
    with pytest.raises(ValueError, match=r"changes|no world named|Field required"):
        make_driver()[0].restore_kept({**kept[-1], **damage})
    with pytest.raises(KeyError):
        make_driver()[0].restore_kept({})


def test_a_robot_whose_first_start_is_blocked_begins_at_the_next() -> None:
    config = CONFIG.model_copy(update={"robot": RobotConfig(id="robot1")})
    robots = [SimRobot(config.robot, load_world("plus"), 1) for _ in range(2)]
    try:
        driver = Driver(config, robots[0], LIFE, Notes())
        kept = notes(driver).kept
        driver.change(switch("plus", start=2), at_once=True)
        driver.change(box(y_m=0.1), at_once=True)
        Driver(config, robots[1], LIFE).restore_kept(kept[-1])
        # The first two starts of Plus are one place.
        assert robots[1].pose == robots[0].pose
        assert [obstacle.name for obstacle in robots[1].obstacles] == ["box"]
        (there,) = kept[-1]["obstacles"]
        blocked = {**kept[-1], "obstacles": [there, {**there, "name": "b", "x_m": -3.8}]}
        with pytest.raises(ValueError, match="obstacles touch every start pose"):
            Driver(config, robots[1], LIFE).restore_kept(blocked)
    finally:
        for robot in robots:
            robot.close()


# ------------------------------------------------------------------------- with an actor


def progress(episodes: int, filling: bool = False) -> RobotProgress:
    return RobotProgress(
        robot="robot1",
        filling=filling,
        fill_missing=0,
        robot_fills=0,
        robot_episodes=episodes,
        episode=episodes,
        robot_life=LIFE,
        last_sequence=-1,
    )


def drive_together(driver: Driver, actor: Actor, actions: int) -> list[Episode]:
    """Lockstep: the robot does what the actor says until so many actions are executed."""
    episodes: list[Episode] = []
    observation = driver.observe()
    actor.begin(progress(0), observation)
    while True:
        if (episode := actor.finish(observation)) is not None:
            episodes.append(episode)
            actor.committed(progress(len(episodes)))
        if driver.sequence >= actions:
            return episodes
        action = actor.act(observation)
        if not driver.apply_due(action.episode):
            assert action.action is not None
            driver.execute(action.action, action.actor_life)
        observation = driver.observe()


def sequences(episode: Episode) -> list[int]:
    """Which looks became samples, as the figurine's pictures tell."""
    images = np.frombuffer(episode.images, np.uint8).reshape(-1, 50, 75)
    return [int(image[0, 0]) for image in images]


def make_actor() -> Actor:
    return Actor(CONFIG, "robot1", "c" * 12, FakePredictor())  # type: ignore[arg-type]


def test_after_a_bump_a_switch_costs_no_sample() -> None:
    driver, robot = make_driver(recovery="none")
    driver.change(switch(at_episode=1))
    robot.contacts = {6, 12}
    actor = make_actor()
    episodes = drive_together(driver, actor, 12)
    assert [(e.ended, e.worlds, e.count) for e in episodes] == [
        ("bump", ("plus",), 6),
        ("bump", ("minus",), 6),
    ]
    assert (actor.dropped_samples, actor.dropped_episodes, actor.actions) == (0, 0, 12)
    assert episodes[1].last_sequence == 11


def test_samples_whose_look_ahead_crosses_a_switch_are_dropped_and_counted() -> None:
    """The full episode carries 4 steps over; the switch that follows it drops just these."""
    driver, robot = make_driver(recovery="none")
    driver.change(switch(at_episode=1))
    robot.contacts = {16}
    actor = make_actor()
    episodes = drive_together(driver, actor, 16)
    assert [(e.ended, e.worlds, e.count) for e in episodes] == [
        ("full", ("plus",), 8),
        ("bump", ("minus",), 4),
    ]
    assert sequences(episodes[0]) == list(range(8))
    assert sequences(episodes[1]) == list(range(12, 16))
    assert (episodes[1].dropped_samples, actor.dropped_samples, actor.actions) == (4, 4, 16)


def test_a_box_drops_nothing() -> None:
    driver, robot = make_driver(recovery="none")
    driver.change(box(at_episode=1))
    robot.contacts = {16}
    actor = make_actor()
    episodes = drive_together(driver, actor, 16)
    assert robot.done == ["+box"]
    assert [(e.ended, sequences(e)) for e in episodes] == [
        ("full", list(range(8))),
        ("bump", list(range(8, 16))),
    ]
    assert (actor.dropped_samples, actor.actions) == (0, 16)


def test_the_action_tells_the_episode_and_none_while_the_memory_fills() -> None:
    driver, _ = make_driver(recovery="none")
    observation: Observation = driver.observe()
    for filling, episodes in ((True, 0), (False, 7)):
        actor = make_actor()
        actor.begin(progress(episodes, filling), observation)
        assert actor.act(observation).episode == episodes
