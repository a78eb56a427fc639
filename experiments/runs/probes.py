"""A fixed set of pictures of each world and what a network predicts for them (Figs 4.7-4.19)."""

from __future__ import annotations

import math
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from experiments.drives.places import start_poses
from services.robot_driver.robot import Pose
from shared.errors import StateError
from shared.facts import ACTION_COUNT, IMAGE_SHAPE
from shared.rl.preprocess import preprocess

if TYPE_CHECKING:  # whoever only reads needs neither simulation nor network
    from services.robot_driver.simulated.sim import SimRobot
    from shared.rl.predictor import Predictor

PLACES = 4
TURNS_DEG = (0.0, 40.0, -40.0)
"""Along the corridor, towards the wall on the left and on the right."""


@dataclass(frozen=True)
class Probes:
    """Pictures of one world and predictions of one network for them."""

    world: str
    images: npt.NDArray[np.uint8]
    """[n, 50, 75]."""
    values: npt.NDArray[np.float64]
    """[n, actions]: clipped predictions for all actions."""


def probe_poses(robot: SimRobot) -> list[Pose]:
    """Where the pictures are taken: the same for every network."""
    turns = [math.radians(turn) for turn in TURNS_DEG]
    return [
        Pose(pose.x_m, pose.y_m, math.remainder(pose.heading_rad + turn, 2.0 * math.pi))
        for pose in start_poses(robot.world, robot.config.radius_m, PLACES)
        for turn in turns
    ]


def take(path: Path, robot: SimRobot, predictor: Predictor) -> None:
    """Take the pictures, predict, and write it all as one file."""
    poses = probe_poses(robot)
    images = np.stack([preprocess(robot.look_from(pose)) for pose in poses])
    np.savez_compressed(
        path,
        world=np.array(robot.world.name),
        images=images,
        values=np.concatenate([predictor.all_values(image[None]) for image in images]),
        x_m=[pose.x_m for pose in poses],
        y_m=[pose.y_m for pose in poses],
        heading_rad=[pose.heading_rad for pose in poses],
    )


def read(path: Path) -> Probes:
    """What was saved, values as float64. Raises StateError if it is damaged or something else."""
    try:
        with np.load(path, allow_pickle=False) as file:
            world, images, values = str(file["world"]), file["images"], file["values"]
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise StateError(f"{path}: {error}") from error
    if images.shape[1:] != IMAGE_SHAPE or images.dtype != np.uint8:
        raise StateError(f"{path}: expected images uint8 [n, 50, 75], got {images.shape}")
    if values.shape != (len(images), ACTION_COUNT):
        raise StateError(
            f"{path}: expected values [{len(images)}, {ACTION_COUNT}], got {values.shape}"
        )
    return Probes(world, images, values.astype(np.float64))
