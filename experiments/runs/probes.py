"""A fixed set of pictures of each world and what a network predicts for them (Figs 4.7-4.19)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from experiments.drives.places import start_poses
from services.robot_driver.robot import Pose
from services.robot_driver.simulated.sim import SimRobot
from shared.messages import ImageArray
from shared.rl.predictor import Predictor
from shared.rl.preprocess import preprocess

PLACES = 4
TURNS_DEG = (0.0, 40.0, -40.0)
"""Along the corridor, towards the wall on the left and on the right."""


@dataclass(frozen=True)
class Probes:
    """Pictures of one world and predictions for them."""

    world: str
    images: npt.NDArray[np.uint8]
    """[n, 50, 75]."""
    values: npt.NDArray[np.float32]
    """[n, actions]: clipped predictions for all actions."""
    poses: npt.NDArray[np.float64]
    """[n, 3]: x, y, heading."""


def probe_poses(robot: SimRobot) -> list[Pose]:
    """Where the pictures are taken: the same for every network."""
    turns = [math.radians(turn) for turn in TURNS_DEG]
    return [
        Pose(pose.x_m, pose.y_m, math.remainder(pose.heading_rad + turn, 2.0 * math.pi))
        for pose in start_poses(robot.world, robot.config.radius_m, PLACES)
        for turn in turns
    ]


def look(robot: SimRobot, predictor: Predictor) -> Probes:
    """Take the pictures and predict."""
    poses = probe_poses(robot)
    images: list[ImageArray] = [preprocess(robot.look_from(pose)) for pose in poses]
    stacked = np.stack(images)
    values = np.concatenate([predictor.all_values(image[None]) for image in stacked])
    places = np.array([(pose.x_m, pose.y_m, pose.heading_rad) for pose in poses])
    return Probes(robot.world.name, stacked, values, places)


def save(path: Path, probes: Probes) -> None:
    """Write them as one file."""
    np.savez_compressed(
        path,
        world=np.array(probes.world),
        images=probes.images,
        values=probes.values,
        x_m=probes.poses[:, 0],
        y_m=probes.poses[:, 1],
        heading_rad=probes.poses[:, 2],
    )
