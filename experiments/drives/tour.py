"""The test drive through I16c: image only, with rotation in place (A45, Fig 4.20, E33).

The network is frozen and acts greedily unless told otherwise, turning on the spot where it predicts
nothing good (`shared.rl.spot_turns`). At a junction towards the end a box is dropped in front of
the robot.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from experiments.drives.choosers import GREEDY, Predicts
from experiments.drives.frozen_drives import Drive
from experiments.drives.routes import Event, Route
from experiments.environment import CorridorEnv
from experiments.records import TourRecord
from services.robot_driver.robot import Pose
from services.robot_driver.simulated.world import World
from services.robot_driver.simulated.world_parts import Place
from services.robot_driver.simulated.world_parts import Route as Line
from shared.config import PolicyConfig
from shared.messages import Box, WorldChange, image_array
from shared.rl.draws import generator
from shared.rl.policy import choose
from shared.rl.spot_turns import SpotTurns

DRIVEN, MOST_DRIVEN = 300, 1200
"""Actions of a full tour at least, turns on the spot not counted, and of one that is given up."""
ROUTE_SHARE, BRIDGES = 0.6, 2
"""Share of the route's length, and number of bridges, that a full tour passes."""
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
BOX_NAME = "dropped-box"


class Tour(NamedTuple):
    """What happened on one test drive."""

    route: Route
    told: TourRecord


def passes(told: TourRecord) -> bool:
    """A full tour without a bump, past the box."""
    full = told.driven >= DRIVEN and told.route_share >= ROUTE_SHARE
    return full and len(told.bridges) >= BRIDGES and told.box_dropped and not told.bumps


class _TestDrive:
    """A tour on its way: poses, bumps and events so far, and what comes next."""

    def __init__(
        self, env: CorridorEnv, network: Predicts, pose: Pose, number: int, policy: PolicyConfig
    ) -> None:
        self._env, self._network, self._policy = env, network, policy
        self._world, self._route = env.robot.world, _route(env.robot.world)
        self._drive = Drive(env, number, pose)
        self._draw = generator(number, ROLE)
        self._spot_turns = SpotTurns(env.config.robot.turn_rad_s * env.config.robot.period_s)
        self._events: list[Event] = []
        self._turned_at = -math.inf
        self._dropped_at: int | None = None
        self.driven = self.turned = 0
        """Actions so far, and turns on the spot so far."""

    def act(self) -> None:
        """Drive or turn as the network says."""
        values = self._network.all_values(image_array(self._drive.observation.image)[None])[0]
        action, _ = choose(values, self._policy, self._draw)
        if side := self._spot_turns.decide(values, action):
            if self.driven > self._turned_at + ONE_TURN:
                self._tell(f"turns {side} on the spot", len(self._drive.bumps))
            self._turned_at = self.driven
            self._drive.turn(left=side == "left")
            self.turned += 1
            return
        if self._drive.act(action):
            self._tell("bumps", len(self._drive.bumps) - 1)
        self.driven += 1

    def full(self) -> bool:
        """Whether the tour is full, in actions, route and bridges, and is past the box."""
        if self._dropped_at is None or self.driven < max(DRIVEN, self._dropped_at + BEYOND_BOX):
            return False
        places_m = self._drive.trace().places_m
        enough = len(_bridges(self._route, places_m)) >= BRIDGES
        return enough and route_share(self._world, places_m) >= ROUTE_SHARE

    def drop_box_if_due(self) -> None:
        """Drop the box across the robot's way, at a junction towards the end, if there is room."""
        pose = self._env.robot.pose
        due = self._dropped_at is None and self.driven >= DROP_AFTER
        junctions = (place for place in self._route.places if place.kind == "junction")
        if not due or not any(_apart_m(place, pose) <= NEAR_M for place in junctions):
            return
        wish = WorldChange(kind="place", box=_box_ahead(pose))
        if self._env.driver.change(wish, at_once=True).accepted:
            self._tell("a box drops in front of the robot", len(self._drive.bumps))
            self._dropped_at = self.driven
        self._drive.observation = self._env.observe()

    def tell_passed(self) -> None:
        """Note named places the first time the robot comes past them."""
        here = self._env.robot.pose
        told = {event.text for event in self._events}
        for place in self._route.places:
            text = f"at {place.name}"
            if text not in told and _apart_m(place, here) <= NEAR_M / 2:
                self._tell(text, len(self._drive.bumps))

    def end(self) -> Tour:
        """Take the box away again and tell what happened."""
        dropped = self._dropped_at is not None
        if dropped:
            self._env.robot.remove(BOX_NAME)
        trace = self._drive.trace()
        told = TourRecord(
            passed=False,
            driven=self.driven,
            turned=self.turned,
            bumps=sum(self._drive.bumps),
            route_share=round(route_share(self._world, trace.places_m), 4),
            bridges=_bridges(self._route, trace.places_m),
            box_dropped=dropped,
        )
        told = told.model_copy(update={"passed": passes(told)})
        return Tour(Route(trace, tuple(self._events)), told)

    def _tell(self, text: str, action: int) -> None:
        self._events.append(Event(len(self._events) + 1, action, text))


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
    drive = _TestDrive(env, network, pose, number, policy)
    while drive.driven < most_driven and drive.driven + drive.turned < 4 * most_driven:
        drive.tell_passed()
        if drive.full():
            break
        drive.drop_box_if_due()
        drive.act()
    return drive.end()


def route_share(world: World, places_m: npt.NDArray[np.float64], near_m: float = NEAR_M) -> float:
    """Part of the route's length along which the robot came, places float64 [n, 2]."""
    line = _route(world).sample(0.1)
    gaps = np.hypot(*(line[:, None] - places_m[None]).transpose(2, 0, 1)).min(axis=1)
    return float(np.mean(gaps <= near_m))


def _route(world: World) -> Line:
    if world.route is None:
        raise ValueError(f"world {world.name!r} has no route")
    return world.route


def _bridges(route: Line, places_m: npt.NDArray[np.float64]) -> tuple[str, ...]:
    return tuple(
        place.name
        for place in route.places
        if place.kind == "bridge"
        and np.hypot(*(places_m - (place.x_m, place.y_m)).T).min() <= NEAR_M
    )


def _apart_m(place: Place, pose: Pose) -> float:
    return math.hypot(place.x_m - pose.x_m, place.y_m - pose.y_m)


def _box_ahead(pose: Pose) -> Box:
    return Box(
        name=BOX_NAME,
        x_m=pose.x_m + BOX_AHEAD_M * math.cos(pose.heading_rad),
        y_m=pose.y_m + BOX_AHEAD_M * math.sin(pose.heading_rad),
        heading_deg=math.degrees(pose.heading_rad),
        length_m=0.3,
        width_m=0.6,
        height_m=0.9,
        rgb=(190, 60, 40),
    )
