"""The one builder from a world to PyBullet, and the only file that imports it.

PyBullet answers two questions: how far is a body at this place from the nearest wall or obstacle,
and what does the camera see from this pose. It never steps time, so nothing it remembers from
earlier questions can influence an answer (A2). For the same reason a scene never changes: where
something is placed or removed, another scene is built.
"""

import copy
import math
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from services.robot_driver.robot import Pose
from services.robot_driver.simulated.textures import box_picture, flat_tile, wall_picture
from services.robot_driver.simulated.world import World
from services.robot_driver.simulated.world_parts import Floats, Obstacle, Surface
from shared.config import CameraConfig

_errors = os.dup(2)
with Path(os.devnull).open("wb") as _nowhere:
    os.dup2(_nowhere.fileno(), 2)
    try:
        import pybullet  # it says on standard error when it was built
    finally:
        os.dup2(_errors, 2)
        os.close(_errors)

REACH_M = 0.5
"""Walls and obstacles farther away than this are not measured."""

WALL_THICKNESS_M = 0.1
_BUMPER_HEIGHT_M = 0.1
_BODY_HEIGHT_M = 0.2
_NEAR_M, _FAR_M = 0.05, 60.0
_SHAPES_PER_BODY = 16
_UPRIGHT = (0.0, 0.0, 0.0, 1.0)
_SQUARE = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))


class _Solid(NamedTuple):
    """An upright box: half its sizes, its middle, and where its first axis points."""

    half: tuple[float, float, float]
    centre: tuple[float, float, float]
    heading_rad: float


class Scene:
    """Solid and textured walls and obstacles, a round body to measure with, and a camera.

    The obstacles are by default what the world begins with; the camera's settings are of A1, E31.
    """

    def __init__(
        self,
        world: World,
        radius_m: float,
        camera: CameraConfig,
        obstacles: Sequence[Obstacle] | None = None,
    ) -> None:
        obstacles = world.obstacles if obstacles is None else obstacles
        self._camera = camera
        self._users = {self}
        """This scene and those it is `shared` with, as long as they are not closed."""
        # Apart, because the renderer would draw solid bodies as well.
        self._solid, self._seen = _connect(), _connect()
        self._obstructions = self._add_solids(
            [*_behind_walls(world), *(_inside(obstacle) for obstacle in obstacles)]
        )
        self._body = self._add_body(radius_m)
        with tempfile.TemporaryDirectory(prefix="textures-") as folder:
            self._add_pictures(world, obstacles, Path(folder))
        self._projection = pybullet.computeProjectionMatrixFOV(
            camera.vertical_fov_deg, camera.aspect, _NEAR_M, _FAR_M
        )

    def clearance(self, x_m: float, y_m: float) -> float:
        """Gap between the shell at (x_m, y_m) and the nearest wall or obstacle, at most `REACH_M`.

        Negative inside one. Depends on the arguments only.
        """
        place = (x_m, y_m, _BUMPER_HEIGHT_M)
        pybullet.resetBasePositionAndOrientation(self._body, place, _UPRIGHT, **self._solid)
        gap = REACH_M
        for body in self._obstructions:
            for point in pybullet.getClosestPoints(self._body, body, REACH_M, **self._solid):
                gap = min(gap, float(point[8]))
        return gap

    def frame(self, pose: Pose, width_px: int = 0, height_px: int = 0) -> npt.NDArray[np.uint8]:
        """What the camera sees with the robot at `pose`: uint8 [h, w, 3], RGB.

        Width and height are the configured ones unless given. The projection keeps its aspect
        ratio, so another ratio of width and height squeezes the picture (E29).
        """
        width, height = width_px or self._camera.render_width_px, height_px
        height = height or self._camera.render_height_px
        picture = pybullet.getCameraImage(
            width,
            height,
            self._view(pose),
            self._projection,
            shadow=0,
            lightDirection=(0.0, 0.0, 1.0),
            lightAmbientCoeff=1.0,
            lightDiffuseCoeff=0.0,
            lightSpecularCoeff=0.0,
            renderer=pybullet.ER_TINY_RENDERER,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
            **self._seen,
        )[2]
        pixels = np.asarray(picture, np.uint8).reshape(height, width, 4)
        return np.ascontiguousarray(pixels[:, :, :3])

    def shared(self) -> "Scene":
        """The same scene for one more user, to be closed by them; it takes no memory to speak of.

        Raises ValueError when it is closed.
        """
        if self not in self._users:
            raise ValueError("a closed scene cannot be shared")
        other = copy.copy(self)
        self._users.add(other)
        return other

    def close(self) -> None:
        """Free everything once nobody uses it any more. May be called twice."""
        if self not in self._users:
            return
        self._users.remove(self)
        if not self._users:
            pybullet.disconnect(**self._solid)
            pybullet.disconnect(**self._seen)

    def _view(self, pose: Pose) -> Any:
        c, s = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
        x = pose.x_m + self._camera.forward_m * c
        y = pose.y_m + self._camera.forward_m * s
        z = self._camera.height_m
        return pybullet.computeViewMatrix((x, y, z), (x + c, y + s, z), (0.0, 0.0, 1.0))

    def _add_body(self, radius_m: float) -> int:
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_CYLINDER, radius=radius_m, height=_BODY_HEIGHT_M, **self._solid
        )
        return self._solid_body(shape)

    def _add_solids(self, solids: Sequence[_Solid]) -> list[int]:
        """Bodies of several boxes each, because that is faster to ask."""
        bodies = []
        for first in range(0, len(solids), _SHAPES_PER_BODY):
            part = solids[first : first + _SHAPES_PER_BODY]
            shape = pybullet.createCollisionShapeArray(
                shapeTypes=[pybullet.GEOM_BOX] * len(part),
                halfExtents=[solid.half for solid in part],
                collisionFramePositions=[solid.centre for solid in part],
                collisionFrameOrientations=[
                    pybullet.getQuaternionFromEuler((0.0, 0.0, solid.heading_rad)) for solid in part
                ],
                **self._solid,
            )
            bodies.append(self._solid_body(shape))
        return bodies

    def _solid_body(self, shape: int) -> int:
        body = int(pybullet.createMultiBody(0, shape, **self._solid))
        # The default margin rounds edges, which reads up to 0.4 mm too much.
        pybullet.changeDynamics(body, -1, collisionMargin=0.0, **self._solid)
        return body

    def _add_pictures(self, world: World, obstacles: Sequence[Obstacle], folder: Path) -> None:
        for wall in world.walls:
            for i, segment in enumerate(wall.segments):
                self._add_side(segment, world.height_m, wall_picture(world, wall, i), folder)
        x0, y0, x1, y1 = world.bounds
        low = [(x0, y0, 0.0), (x1, y0, 0.0), (x1, y1, 0.0), (x0, y1, 0.0)]
        high = [(x, y, world.height_m) for x, y, _ in reversed(low)]
        self._add_flat(world, world.floor, low, folder)
        self._add_flat(world, world.ceiling, high, folder)
        for obstacle in obstacles:
            self._add_box(obstacle, folder)

    def _add_box(self, obstacle: Obstacle, folder: Path) -> None:
        for segment in obstacle.segments:
            ax, ay, bx, by = segment
            length, angle = math.hypot(bx - ax, by - ay), math.atan2(by - ay, bx - ax)
            picture = box_picture(length, obstacle.height_m, obstacle.rgb, angle)
            self._add_side(segment, obstacle.height_m, picture, folder)
        top = [(x, y, obstacle.height_m) for x, y in obstacle.corners]
        self._add_quad(top, list(_SQUARE), np.full((8, 8, 3), obstacle.rgb, np.uint8), folder)

    def _add_side(
        self, segment: Floats, height_m: float, picture: npt.NDArray[np.uint8], folder: Path
    ) -> None:
        """An upright picture from the floor up. Seen, the segment runs from right to left."""
        ax, ay, bx, by = segment
        corners = [(bx, by, 0.0), (ax, ay, 0.0), (ax, ay, height_m), (bx, by, height_m)]
        self._add_quad(corners, list(_SQUARE), picture, folder)

    def _add_flat(
        self,
        world: World,
        surface: Surface,
        corners: list[tuple[float, float, float]],
        folder: Path,
    ) -> None:
        tile, size_m = flat_tile(world.textures[surface.texture])
        uv = [(x / size_m, y / size_m) for x, y, _ in corners]
        low = (math.floor(min(u for u, _ in uv)), math.floor(min(v for _, v in uv)))
        self._add_quad(corners, [(u - low[0], v - low[1]) for u, v in uv], tile, folder)

    def _add_quad(
        self,
        corners: list[tuple[float, float, float]],
        uv: list[tuple[float, float]],
        picture: npt.NDArray[np.uint8],
        folder: Path,
    ) -> None:
        """A rectangle seen from the side where its corners run anticlockwise."""
        p = np.array(corners)
        normal = np.cross(p[1] - p[0], p[3] - p[0])
        normal = (normal / np.linalg.norm(normal)).tolist()
        shape = pybullet.createVisualShape(
            pybullet.GEOM_MESH,
            vertices=p.tolist(),
            indices=[0, 1, 2, 0, 2, 3],
            uvs=[list(pair) for pair in uv],
            normals=[normal] * 4,
            rgbaColor=(1.0, 1.0, 1.0, 1.0),
            **self._seen,
        )
        body = pybullet.createMultiBody(0, -1, shape, **self._seen)
        path = folder / f"{body}.png"
        cv2.imwrite(str(path), np.ascontiguousarray(picture[:, :, ::-1]))
        texture = pybullet.loadTexture(str(path), **self._seen)
        pybullet.changeVisualShape(body, -1, textureUniqueId=texture, **self._seen)


def _behind_walls(world: World) -> list[_Solid]:
    """Boxes behind the visible faces of the walls."""
    solids = []
    for ax, ay, bx, by in world.segments:
        dx, dy = bx - ax, by - ay
        length = math.hypot(dx, dy)
        back = WALL_THICKNESS_M / 2 / length
        solids.append(
            _Solid(
                (length / 2, WALL_THICKNESS_M / 2, world.height_m / 2),
                ((ax + bx) / 2 + dy * back, (ay + by) / 2 - dx * back, world.height_m / 2),
                math.atan2(dy, dx),
            )
        )
    return solids


def _inside(obstacle: Obstacle) -> _Solid:
    half_height = obstacle.height_m / 2
    return _Solid(
        (obstacle.length_m / 2, obstacle.width_m / 2, half_height),
        (obstacle.x_m, obstacle.y_m, half_height),
        math.radians(obstacle.heading_deg),
    )


def _connect() -> dict[str, int]:
    client = int(pybullet.connect(pybullet.DIRECT))
    if client < 0:
        raise RuntimeError("PyBullet did not start")
    return {"physicsClientId": client}
