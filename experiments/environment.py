"""The corridors as Gymnasium environments: `corridor/Plus-v0` and one more for every world.

Importing this module registers them; `gymnasium.make("experiments.environment:corridor/Plus-v0")`
does both at once. The single-process loop and all evaluation run on the same class.
"""

import math
from collections import deque
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.error import InvalidAction, ResetNeeded

from services.robot_driver.driver import Driver
from services.robot_driver.robot import Pose
from services.robot_driver.simulated.kinematics import wrap
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import WORLDS, World, load_world
from shared.config import Config
from shared.facts import ACTION_COUNT, IMAGE_HEIGHT, IMAGE_WIDTH
from shared.messages import Observation, image_array

LIFE = "0" * 12
"""Life ids are random in the services; comparison ignores them."""
MAX_EPISODE_STEPS = 500
"""Longest episode of the registered environments, as in A9."""
REWARDS = ("progress", "distance")
PICTURE_PX = 480, 270
"""Width and height of a rendered picture."""
Image = npt.NDArray[np.uint8]
Info = dict[str, Any]


class CorridorEnv(gymnasium.Env[Image, np.int64]):
    """One simulated robot behind its driver.

    Observation: the grey image, uint8 [50, 75, 1]. Action: its number in the table of
    actions (A21). Reward: -1 at a bump, else how far the robot is from where it was one action ago
    (`progress`) or `episode.horizon` actions ago (`distance`), as a part of the farthest possible.
    Until there are so many actions in an episode its first place counts.
    A bump ends an episode; how many actions end one without a bump is for a wrapper to say, and the
    registered environments have one.

    The next episode begins where the last one ended (A8), after the driver has recovered from the
    bump (E11). With a seed it begins at a start pose that is drawn from it, and so are the
    recoveries; option `pose` (a `Pose`) names another place.

    At a bump no picture is taken: `step` gives the image the robot acted on once more, because what
    is seen in contact is never acted from (E6). `info` has plain numbers: `x_m`, `y_m`,
    `heading_rad`, `bump`, `laps_left` and `laps_right`. `seen` is all that the driver told last.

    Args:
        world: Name of the world, or path of its file; default: the configured one.
        config: Robot, episode and seed.
        robot: An existing robot to drive instead of a new one, from where it is. A seed puts it
            back into the world where it was, among the obstacles that stood there.
        render_mode: `rgb_array`: `render` gives what the camera sees, in colour.
        reward: `progress`, which is the same for driving and circling, or `distance`.

    Raises:
        ValueError: Another render mode or reward.
        WorldError: No such world.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012

    def __init__(
        self,
        world: str | None = None,
        *,
        config: Config | None = None,
        robot: SimRobot | None = None,
        render_mode: str | None = None,
        reward: str = "progress",
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode: expected None or 'rgb_array', got {render_mode!r}")
        if reward not in REWARDS:
            raise ValueError(f"reward: expected one of {', '.join(REWARDS)}, got {reward!r}")
        self.config = with_world(config or Config(), world)
        chosen, file = self.config.robot, world or self.config.robot.world
        self.robot = robot or SimRobot(chosen, load_world(file), self.config.run.seed)
        self.driver = Driver(self.config, self.robot, LIFE)
        """Replaced when `reset` is given a seed."""
        self.render_mode = render_mode
        self.observation_space = spaces.Box(0, 255, (IMAGE_HEIGHT, IMAGE_WIDTH, 1), np.uint8)
        self.action_space = spaces.Discrete(ACTION_COUNT)
        self._start, self._home = self.robot.state(), self.robot.world
        back = 1 if reward == "progress" else self.config.episode.horizon
        self._longest_m = chosen.speed_m_s * chosen.period_s * back
        self._places: deque[tuple[float, float]] = deque(maxlen=back + 1)
        self._newest: Observation | None = None
        self._bumped = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Image, Info]:
        """Begin an episode. Raises ValueError for a pose inside a wall or without a seed."""
        super().reset(seed=seed, options=options)
        pose: Pose | None = (options or {}).get("pose")
        if seed is not None:
            self._restart(seed, pose or self._drawn_start())
        elif pose is not None:
            raise ValueError("reset: the option 'pose' needs a seed, for the recoveries to come")
        elif self._bumped:
            self.driver.settle(True)
        self._bumped = False
        seen = self.observe()
        self._places.clear()
        self._places.append((seen.x_m, seen.y_m))
        return _pixels(seen), self._info()

    def step(self, action: np.int64) -> tuple[Image, float, bool, bool, Info]:
        """Drive one action and look, unless it ended in a bump.

        Raises:
            InvalidAction: Not 0, 1 or 2.
            ResetNeeded: There was no `reset` yet, or none since the bump.
        """
        if not self.action_space.contains(action):
            raise InvalidAction(f"expected an action 0..{ACTION_COUNT - 1}, got {action!r}")
        before = self._newest
        if before is None or self._bumped:
            raise ResetNeeded("call reset() at first and after a bump")
        self.driver.start(int(action), LIFE)
        self._bumped = self.driver.advance(self.config.robot.period_s)
        if self._bumped:
            return _pixels(before), -1.0, True, False, self._info()
        self.driver.settle(False)
        after = self.observe()
        self._places.append((after.x_m, after.y_m))
        way_m = math.dist(self._places[0], self._places[-1])
        return _pixels(after), way_m / self._longest_m, False, False, self._info()

    @property
    def seen(self) -> Observation:
        """The newest observation. Raises ResetNeeded when there is none yet."""
        if self._newest is None:
            raise ResetNeeded("call reset() at first")
        return self._newest

    @property
    def world(self) -> World:
        """The world the robot is in, with the obstacles that stand there now."""
        return self.robot.world.model_copy(update={"obstacles": self.robot.obstacles})

    def turn(self, left: bool) -> Observation:
        """Turn on the spot for the time of one action, which is none of the three, and look."""
        self.driver.move("turn-left" if left else "turn-right")
        return self.observe()

    def observe(self) -> Observation:
        """Sense now, as after a change of the world that was no action."""
        self._newest = self.driver.observe()
        return self._newest

    def render(self) -> Image | None:
        """What the camera sees, uint8 [270, 480, 3] RGB; None without the render mode."""
        return self.robot.frame(*PICTURE_PX) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Free the simulation. May be called twice."""
        self.robot.close()

    def _info(self) -> Info:
        pose, laps, seen = self.robot.pose, self.robot.laps, self.seen
        return {
            "x_m": pose.x_m,
            "y_m": pose.y_m,
            "heading_rad": pose.heading_rad,
            "bump": int(self._bumped or seen.bump),
            "laps_left": laps.left,
            "laps_right": laps.right,
        }

    def _drawn_start(self) -> Pose:
        starts = self._home.starts
        start = starts[int(self.np_random.integers(len(starts)))]
        return Pose(start.x_m, start.y_m, wrap(math.radians(start.heading_deg)))

    def _restart(self, seed: int, pose: Pose) -> None:
        """Stand the robot somewhere in the world it began in, with time and laps at zero."""
        zero = {key: v if isinstance(v, str) else 0 for key, v in self._start.items()}
        place = {"x_m": pose.x_m, "y_m": pose.y_m, "heading_rad": pose.heading_rad}
        self.robot.restore(zero | place)
        run = self.config.run.model_copy(update={"seed": seed})
        self.driver = Driver(self.config.model_copy(update={"run": run}), self.robot, LIFE)


def with_world(config: Config, world: str | None) -> Config:
    """The configuration with another world, if one is named."""
    if world is None:
        return config
    name = Path(world).stem
    return config.model_copy(update={"robot": config.robot.model_copy(update={"world": name})})


def env_id(world: str) -> str:
    """The id a world's environment is registered under."""
    return f"corridor/{world.capitalize()}-v0"


def register(world: str | Path) -> str:
    """Register the environment of a world, given by name or file; returns its id."""
    name = env_id(Path(world).stem)
    gymnasium.register(
        id=name,
        entry_point="experiments.environment:CorridorEnv",
        max_episode_steps=MAX_EPISODE_STEPS,
        kwargs={"world": str(world)},
    )
    return name


def _pixels(observation: Observation) -> Image:
    return image_array(observation.image)[:, :, np.newaxis]


for _file in sorted(WORLDS.glob("*.toml")):
    register(_file.stem)
