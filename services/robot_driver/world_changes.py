"""Changes of a robot's world: checked, kept until the episode they are due in, carried out."""

from bisect import insort
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import Any

from pydantic import ValidationError

from services.robot_driver.robot import ChangeableWorld
from services.robot_driver.simulated.world import World, WorldError, load_world
from services.robot_driver.simulated.world_parts import Obstacle
from shared.codec import decode, encode
from shared.errors import BadMessage, first_problem
from shared.messages import Box, WorldChange, WorldChanged

MAX_PENDING = 64
"""More changes than this do not wait for an episode; further ones are refused."""
MAX_REMEMBERED = 64
"""Answers kept for wishes that are sent again because the answer was lost."""


class WorldChanges:
    """The changes of one robot's world; without a robot every change is refused."""

    def __init__(self, robot: ChangeableWorld | None) -> None:
        self._robot = robot
        self._pending: list[WorldChange] = []
        self._answers: OrderedDict[str, WorldChanged] = OrderedDict()

    @property
    def world(self) -> str | None:
        """Name of the world the robot is in now; None where it cannot be changed."""
        return self._robot.world.name if self._robot else None

    @property
    def pending(self) -> tuple[WorldChange, ...]:
        """What waits, in the order in which it will be carried out."""
        return tuple(self._pending)

    def known(self, change: WorldChange) -> WorldChanged | None:
        """The answer that this wish was given before, if it is one sent again."""
        return self._answers.get(change.id) if change.id else None

    def add(self, change: WorldChange) -> None:
        """Keep a change until it is due. Raises ValueError if that cannot be, as far as known."""
        if self._robot is None:
            raise ValueError("the world of this robot cannot be changed")
        waits = change.at_episode > 0
        if sum((other.at_episode > 0) == waits for other in self._pending) >= MAX_PENDING:
            raise ValueError(f"{MAX_PENDING} changes wait already")
        self._check(change, self._robot)
        insort(self._pending, change, key=attrgetter("at_episode"))

    def withdraw(self, ident: str) -> str:
        """Forget a change that waits; return why not, if there is none with this id."""
        count = len(self._pending)
        self._pending = [change for change in self._pending if change.id != ident]
        return "" if len(self._pending) < count else f"no change with id {ident} waits"

    def carry_out(self, episode: int) -> list[tuple[WorldChange, str]]:
        """Carry out, in order, what is due in this episode; each with why not, or nothing."""
        count = sum(change.at_episode <= episode for change in self._pending)
        due, self._pending = self._pending[:count], self._pending[count:]
        return [(change, self._refusal(change)) for change in due]

    def answer(self, change: WorldChange, refusal: str) -> WorldChanged:
        """The answer to a wish; to a change it is remembered in case that is sent again."""
        robot = self._robot
        answer = WorldChanged(
            accepted=not refusal,
            reason=refusal,
            world=robot.world.name if robot else "",
            obstacles=tuple(obstacle.name for obstacle in robot.obstacles) if robot else (),
            pending=len(self._pending),
            waiting=tuple(self._pending) if change.kind in ("withdraw", "list") else (),
        )
        if change.id and change.kind != "withdraw":
            self._answers[change.id] = answer
            if len(self._answers) > MAX_REMEMBERED:
                self._answers.popitem(last=False)
        return answer

    def saved(self) -> list[bytes]:
        """What waits, for msgpack."""
        return [encode(change) for change in self._pending]

    def restore(self, saved: Sequence[bytes]) -> None:
        """Continue from `saved()`. Raises ValueError when it is damaged."""
        try:
            self._pending = [decode(data, WorldChange) for data in saved]
        except BadMessage as error:
            raise ValueError(f"changes: {error}") from error

    def kept(self) -> dict[str, Any]:
        """What outlives even a killed driver: the world, its obstacles and what waits."""
        robot = self._robot
        return {
            "world": robot.world.name if robot else "",
            "obstacles": [o.model_dump() for o in robot.obstacles] if robot else [],
            "pending": self.saved(),
        }

    def restore_kept(self, kept: Mapping[str, Any]) -> None:
        """Bring a robot that begins anew into the world that was kept, where it touches nothing.

        Raises KeyError, TypeError or ValueError: it is damaged, or the robot cannot stand anywhere.
        """
        obstacles = tuple(Obstacle.model_validate(tree) for tree in kept["obstacles"])
        self.restore(kept["pending"])
        robot = self._robot
        if robot is not None and (kept["world"], obstacles) != (robot.world.name, robot.obstacles):
            _furnish(robot, _world(kept["world"]), obstacles)

    def _check(self, change: WorldChange, robot: ChangeableWorld) -> None:
        """Against the world there will be when it is due, if no other changes come between."""
        world, names = robot.world, {obstacle.name for obstacle in robot.obstacles}
        for earlier in self._pending:
            if earlier.at_episode > change.at_episode:
                break
            world, names = _after(earlier, world, names)
        if change.box is not None:
            world.check_placing(obstacle_of(change.box), names)
        elif change.name is not None and change.name not in names:
            raise ValueError(f"there is no obstacle {change.name!r}")
        elif change.world is not None:
            _world(change.world).check_start(change.start)

    def _refusal(self, change: WorldChange) -> str:
        """Carry out one change; return why not, if so."""
        if self._robot is None:
            return "the world of this robot cannot be changed"
        try:
            if change.box is not None:
                self._robot.place(obstacle_of(change.box))
            elif change.name is not None:
                self._robot.remove(change.name)
            elif change.world is not None:
                self._robot.switch(_world(change.world), change.start)
        except ValueError as error:
            return str(error)
        return ""


def obstacle_of(box: Box) -> Obstacle:
    """The obstacle that a message describes. Raises ValueError in one line."""
    try:
        return Obstacle.model_validate(box.model_dump())
    except ValidationError as error:
        raise ValueError(f"obstacle {box.name!r}: {first_problem(error)}") from error


def described(change: WorldChange) -> str:
    """A change in a few words, for a log."""
    if change.kind == "withdraw":
        return f"withdraw the change {change.id}"
    if change.box is not None:
        return f"place obstacle {change.box.name!r} at ({change.box.x_m:g}, {change.box.y_m:g})"
    if change.name is not None:
        return f"remove obstacle {change.name!r}"
    return f"switch to world {change.world!r}, start {change.start}"


def _furnish(robot: ChangeableWorld, world: World, obstacles: tuple[Obstacle, ...]) -> None:
    """Put a robot into a world with just these obstacles. Raises ValueError."""
    for start in range(len(world.starts)):
        try:
            robot.switch(world, start)
            for there in robot.obstacles:
                if there not in obstacles:
                    robot.remove(there.name)
            for obstacle in obstacles:
                if obstacle not in robot.obstacles:
                    robot.place(obstacle)
        except ValueError:
            continue  # it would touch something there
        return
    raise ValueError(f"world {world.name!r}: obstacles touch every start pose")


def _after(change: WorldChange, world: World, names: set[str]) -> tuple[World, set[str]]:
    """World and names of the obstacles after a change."""
    if change.box is not None:
        return world, names | {change.box.name}
    if change.name is not None:
        return world, names - {change.name}
    switched = _world(change.world or "")
    return switched, {obstacle.name for obstacle in switched.obstacles}


def _world(name: str) -> World:
    try:
        return load_world(name)
    except WorldError as error:
        raise ValueError(str(error)) from error
