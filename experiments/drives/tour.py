"""The test drive through I16c: image only, with rotation in place (A45, Fig 4.20, E33).

The network is frozen and acts greedily unless told otherwise, turning on the spot where it predicts
nothing good (`shared.rl.spot_turns`). At a junction towards the end a box is dropped in front of
the robot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from experiments.drives.choosers import GREEDY, Predicts
from experiments.drives.routes import Event, Route
from experiments.drives.traces import Trace
from experiments.environment import CorridorEnv
from experiments.records import TourRecord
from services.robot_driver.robot import Pose
from services.robot_driver.simulated.world import World
from shared.config import PolicyConfig
from shared.messages import Box, Observation, WorldChange, image_array
from shared.rl.draws import generator
from shared.rl.policy import choose
from shared.rl.spot_turns import SpotTurns

DRIVEN, MOST_DRIVEN = 300, 1200
"""Actions of a full tour at least, turns on the spot not counted, and of one that is given up."""
ROUTE_SHARE, BRIDGES = 0.6, 2
"""Of the route's length, and how many bridges, a full tour comes along."""
DROP_AFTER = 200
"""Driven actions after which the next junction counts as the last one."""
BEYOND_BOX = 30
"""Actions driven after the box was dropped, before a tour is over."""
NEAR_M = 1.0
"""A place is passed within this distance."""
BOX_AHEAD_M = 1.1
ONE_TURN = 5
"""Turns on the spot with no more driven actions between them are told as one event."""

ROLE = "tour"


@dataclass(frozen=True)
class Tour:
    """What happened on one test drive."""

    route: Route
    driven: int
    turned: int
    """Turns on the spot, each of one action's duration."""
    route_share: float
    bridges: tuple[str, ...]
    box_dropped: bool

    @property
    def bumps(self) -> int:
        """Bumps of the whole drive."""
        return int(self.route.trace.bumps.sum())

    @property
    def told(self) -> TourRecord:
        """The figures, for a file."""
        return TourRecord(
            passed=self.passed,
            driven=self.driven,
            turned=self.turned,
            bumps=self.bumps,
            route_share=round(self.route_share, 4),
            bridges=self.bridges,
            box_dropped=self.box_dropped,
        )

    @property
    def passed(self) -> bool:
        """A full tour without a bump, past the box."""
        full = self.driven >= DRIVEN and self.route_share >= ROUTE_SHARE
        return full and len(self.bridges) >= BRIDGES and self.box_dropped and not self.bumps


@dataclass
class _Log:
    """Poses, bumps and events so far."""

    poses: list[tuple[float, float, float]]
    bumps: list[bool] = field(default_factory=list)
    driven: list[bool] = field(default_factory=list)
    way_m: list[float] = field(default_factory=list)
    """Of each action; recovery not included."""
    events: list[Event] = field(default_factory=list)

    def tell(self, text: str) -> None:
        self.events.append(Event(len(self.events) + 1, len(self.bumps), text))

    def add(self, pose: Pose, *, bump: bool, driven: bool, way_m: float = 0.0) -> None:
        self.poses.append((pose.x_m, pose.y_m, pose.heading_rad))
        self.bumps.append(bump)
        self.driven.append(driven)
        self.way_m.append(way_m)


def drive_tour(
    env: CorridorEnv,
    network: Predicts,
    pose: Pose,
    number: int,
    policy: PolicyConfig = GREEDY,
    most_driven: int = MOST_DRIVEN,
) -> Tour:
    """One test drive from a pose, in a world with a route: until it is full, or given up.

    Args:
        env: Its obstacles stay as they were found: the box is taken away again.
        network: Frozen.
        pose: Where to begin, standing.
        number: Seeds draws of the policy, and recoveries.
        policy: How actions are chosen.
        most_driven: Driven actions after which a tour that is not full is given up; it is too
            after four times as many with the turns on the spot.

    Raises:
        ValueError: The world has no route, or the pose is inside a wall.
    """
    world = env.robot.world
    if world.route is None:
        raise ValueError(f"world {world.name!r} has no route")
    observation: Observation = env.reset(seed=number, options={"pose": pose})[1]["observation"]
    log = _Log([(pose.x_m, pose.y_m, pose.heading_rad)])
    dropped, dropped_at = False, 0
    draw = generator(number, ROLE)
    spot_turns = SpotTurns(env.config.robot.turn_rad_s * env.config.robot.period_s)
    turned_at = -math.inf
    while (driven := sum(log.driven)) < most_driven and len(log.bumps) < 4 * most_driven:
        _tell_passed(world, log)
        if dropped and driven >= max(DRIVEN, dropped_at + BEYOND_BOX) and _full(world, log):
            break
        if not dropped and driven >= DROP_AFTER and _at_junction(world, env.robot.pose):
            dropped, dropped_at = _drop_box(env, log), driven
            observation = env.observe()
        values = network.all_values(image_array(observation.image)[None])[0]
        action, _ = choose(values, policy, draw)
        if side := spot_turns.decide(values, action):
            if driven > turned_at + ONE_TURN:
                log.tell(f"turns {side} on the spot")
            turned_at = driven
            observation = env.turn(side == "left")
            log.add(env.robot.pose, bump=False, driven=False)
            continue
        before = env.robot.pose
        _, _, bumped, _, info = env.step(np.int64(action))
        here = env.robot.pose
        way_m = math.hypot(here.x_m - before.x_m, here.y_m - before.y_m)
        if bumped:
            _, info = env.reset()
            log.tell("bumps")
        observation = info["observation"]
        log.add(env.robot.pose, bump=bumped, driven=True, way_m=way_m)
    if dropped:
        env.robot.remove(BOX_NAME)
    return _tour(env, log, dropped)


BOX_NAME = "dropped-box"


def route_share(world: World, places_m: npt.NDArray[np.float64], near_m: float = NEAR_M) -> float:
    """Part of the route's length along which the robot came, places float64 [n, 2]."""
    assert world.route is not None
    line = world.route.sample(0.1)
    gaps = np.hypot(*(line[:, None] - places_m[None]).transpose(2, 0, 1)).min(axis=1)
    return float(np.mean(gaps <= near_m))


def _full(world: World, log: _Log) -> bool:
    """Whether the robot has come along enough of the route and over enough bridges."""
    places_m = np.array(log.poses)[:, :2]
    return len(_bridges(world, places_m)) >= BRIDGES and route_share(world, places_m) >= ROUTE_SHARE


def _bridges(world: World, places_m: npt.NDArray[np.float64]) -> tuple[str, ...]:
    assert world.route is not None
    return tuple(
        place.name
        for place in world.route.places
        if place.kind == "bridge" and _nearest_m(places_m, place.x_m, place.y_m) <= NEAR_M
    )


def _tour(env: CorridorEnv, log: _Log, dropped: bool) -> Tour:
    world, poses = env.robot.world, np.array(log.poses)
    laps = env.robot.laps
    trace = Trace(
        world=world.name,
        bumps=np.array(log.bumps, np.bool_),
        places_m=poses[:, :2],
        headings_rad=poses[:, 2],
        way_m=np.array(log.way_m),
        laps_left=laps.left,
        laps_right=laps.right,
    )
    driven = sum(log.driven)
    return Tour(
        Route(trace, tuple(log.events)),
        driven,
        len(log.driven) - driven,
        route_share(world, poses[:, :2]),
        _bridges(world, poses[:, :2]),
        dropped,
    )


def _nearest_m(places_m: npt.NDArray[np.float64], x_m: float, y_m: float) -> float:
    return float(np.hypot(places_m[:, 0] - x_m, places_m[:, 1] - y_m).min())


def _tell_passed(world: World, log: _Log) -> None:
    """Note named places the first time the robot comes past them."""
    assert world.route is not None
    x, y, _ = log.poses[-1]
    told = {event.text for event in log.events}
    for place in world.route.places:
        text = f"at {place.name}"
        if text not in told and math.hypot(place.x_m - x, place.y_m - y) <= NEAR_M / 2:
            log.tell(text)


def _at_junction(world: World, pose: Pose) -> bool:
    assert world.route is not None
    return any(
        place.kind == "junction"
        and math.hypot(place.x_m - pose.x_m, place.y_m - pose.y_m) <= NEAR_M
        for place in world.route.places
    )


def _drop_box(env: CorridorEnv, log: _Log) -> bool:
    """Drop the box across the robot's way; False where a wall leaves no place for it."""
    pose = env.robot.pose
    box = Box(
        name=BOX_NAME,
        x_m=pose.x_m + BOX_AHEAD_M * math.cos(pose.heading_rad),
        y_m=pose.y_m + BOX_AHEAD_M * math.sin(pose.heading_rad),
        heading_deg=math.degrees(pose.heading_rad),
        length_m=0.3,
        width_m=0.6,
        height_m=0.9,
        rgb=(190, 60, 40),
    )
    done = env.driver.change(WorldChange(kind="place", box=box), at_once=True)
    if done.accepted:
        log.tell("a box drops in front of the robot")
    return done.accepted
