"""Pictures of a world for people: a map from above and what the camera sees from several places."""

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from services.robot_driver.robot import Pose
from services.robot_driver.simulated.scene import Scene
from services.robot_driver.simulated.world import World, load_world
from services.robot_driver.simulated.world_parts import Obstacle, Route
from shared.config import RobotConfig
from shared.rl.preprocess import preprocess

Picture = npt.NDArray[np.uint8]
"""uint8 [h, w, 3], RGB."""
Colour = tuple[int, int, int]
Point = tuple[float, float]

PIXELS_PER_M = 90
_MARGIN_PX = 110
_INK: Colour = (40, 44, 52)
_GREY: Colour = (120, 124, 132)
_SOLID: Colour = (206, 206, 202)
_FREE: Colour = (247, 246, 242)
_ROBOT: Colour = (44, 110, 190)
_LAP: Colour = (200, 60, 50)
_ROUTE: Colour = (40, 140, 80)


def render(name: str, out: Path) -> None:
    """Write `map.png`, `view-*.png` (640x360) and `image-*.png` (what the network sees, enlarged).

    name: Of the world, or the path of its file.

    Raises WorldError: the world is missing or wrong; OSError: a file cannot be written.
    """
    world, robot = load_world(name), RobotConfig()
    out.mkdir(parents=True, exist_ok=True)
    poses = viewpoints(world)
    _write(out / "map.png", draw_map(world, robot.radius_m, poses))
    scene = Scene(world, robot.radius_m, robot.camera)
    try:
        for i, pose in enumerate(poses, start=1):
            _write(out / f"view-{i}.png", scene.frame(pose, 640, 360))
            grey = preprocess(scene.frame(pose)).repeat(10, axis=0).repeat(10, axis=1)
            _write(out / f"image-{i}.png", np.repeat(grey[..., None], 3, 2))
    finally:
        scene.close()


def viewpoints(world: World, count: int = 8) -> list[Pose]:
    """Places far from each other and from walls, each looking along the longest line of sight."""
    x0, y0, x1, y1 = world.bounds
    points = np.mgrid[x0:x1:0.2, y0:y1:0.2].reshape(2, -1).T
    room = world.clearance(points)
    points = points[room > 0.6 * room.max()]
    chosen = [np.array([world.starts[0].x_m, world.starts[0].y_m])]
    while len(chosen) < count:
        apart = np.min([np.linalg.norm(points - c, axis=1) for c in chosen], axis=0)
        chosen.append(points[int(np.argmax(apart))])
    headings = np.linspace(-math.pi, math.pi, 72, endpoint=False)
    poses = []
    for x, y in chosen:
        far = world.sight(np.repeat([[x, y]], len(headings), axis=0), headings)
        poses.append(Pose(float(x), float(y), float(headings[int(np.argmax(far))])))
    return poses


def draw_map(world: World, radius_m: float, poses: list[Pose]) -> Picture:
    """The world from above: walls in their texture's colour, obstacles, route, starts, lap line."""
    sheet = _Sheet(world)
    for wall in world.walls:
        sheet.fill(wall.points, _FREE if wall.area_m2 > 0.0 else _SOLID)
    for wall in world.walls:
        for i, (ax, ay, bx, by) in enumerate(wall.segments):
            texture = world.textures[wall.texture_of(i)]
            rgb = texture.accent if texture.kind == "plaster" else texture.rgb
            sheet.line((ax, ay), (bx, by), rgb, 9)
    _draw_fixtures(sheet, world)
    for obstacle in world.obstacles:
        sheet.fill(obstacle.corners.tolist(), obstacle.rgb, _INK)
        sheet.label((obstacle.x_m, obstacle.y_m), obstacle.name, _off_walls(world, obstacle))
    if world.route is not None:
        _draw_route(sheet, world.route)
    for i, start in enumerate(world.starts):
        pose = Pose(start.x_m, start.y_m, math.radians(start.heading_deg))
        sheet.robot(pose, radius_m)
        beside = Pose(pose.x_m, pose.y_m, pose.heading_rad - math.pi / 2)
        sheet.label(_ahead(beside, 0.5 * radius_m), f"S{i}", (0.0, 0.0), _ROBOT)
    if world.lap is not None:
        sheet.line(*world.lap.line, _LAP, 3)
        (x, y), (x2, y2) = world.lap.line
        sheet.text(((x + x2) / 2 + 0.4, (y + y2) / 2 + 0.08), "lap", _LAP)
        sheet.dot(world.lap.centre, _LAP)
    for i, pose in enumerate(poses, start=1):
        sheet.eye(pose, str(i))
    sheet.legend(world)
    return sheet.pixels


class _Sheet:
    """A picture with metres for coordinates."""

    def __init__(self, world: World) -> None:
        self._x0, y0, x1, self._y1 = world.bounds
        size = (self._y1 - y0, x1 - self._x0)
        h, w = (round(length * PIXELS_PER_M) + 2 * _MARGIN_PX for length in size)
        self.pixels: Picture = np.full((h, w, 3), _SOLID, np.uint8)

    def at(self, x: float, y: float) -> tuple[int, int]:
        """Pixel column and row of a place."""
        column = _MARGIN_PX + (x - self._x0) * PIXELS_PER_M
        return round(column), round(_MARGIN_PX + (self._y1 - y) * PIXELS_PER_M)

    def fill(self, points: Sequence[Point], rgb: Colour, edge: Colour | None = None) -> None:
        corners = np.array([self.at(*point) for point in points], np.int32)
        cv2.fillPoly(self.pixels, [corners], rgb, cv2.LINE_AA)
        if edge is not None:
            cv2.polylines(self.pixels, [corners], True, edge, 1, cv2.LINE_AA)

    def line(self, a: Point, b: Point, rgb: Colour, width_px: int) -> None:
        cv2.line(self.pixels, self.at(*a), self.at(*b), rgb, width_px, cv2.LINE_AA)

    def dot(self, place: Point, rgb: Colour, radius_px: int = 5) -> None:
        cv2.circle(self.pixels, self.at(*place), radius_px, rgb, -1, cv2.LINE_AA)

    def text(self, place: Point, words: str, rgb: Colour = _INK) -> None:
        _put(self.pixels, self.at(*place), words, rgb)

    def label(self, place: Point, words: str, way: Point, rgb: Colour = _INK) -> None:
        """Words beside a place, in direction `way` from it (metres; right and up), with a rim."""
        (w, h), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, 0.45, 1)
        column, row = self.at(place[0] + way[0], place[1] + way[1])
        column += round((np.sign(round(way[0], 6)) - 1) * w / 2)
        row += round((1 - np.sign(round(way[1], 6))) * h / 2)
        _put(self.pixels, (column, row), words, _FREE, 0.45, 4)
        _put(self.pixels, (column, row), words, rgb, 0.45)

    def robot(self, pose: Pose, radius_m: float) -> None:
        """The round shell with an arrow along its heading."""
        centre, radius = self.at(pose.x_m, pose.y_m), round(radius_m * PIXELS_PER_M)
        cv2.circle(self.pixels, centre, radius, _ROBOT, 2, cv2.LINE_AA)
        tip = self.at(*_ahead(pose, 2.0 * radius_m))
        cv2.arrowedLine(self.pixels, centre, tip, _ROBOT, 3, cv2.LINE_AA, tipLength=0.35)

    def eye(self, pose: Pose, label: str) -> None:
        """A viewpoint with its number."""
        self.line((pose.x_m, pose.y_m), _ahead(pose, 0.35), _GREY, 2)
        self.dot((pose.x_m, pose.y_m), _GREY)
        self.text((pose.x_m + 0.08, pose.y_m - 0.2), label, _GREY)

    def legend(self, world: World) -> None:
        """Title and scale bar."""
        _put(self.pixels, (_MARGIN_PX, 48), f"{world.name}: {world.title}", _INK, 0.8)
        row = self.pixels.shape[0] - 50
        for metre in range(2):
            left = _MARGIN_PX + metre * PIXELS_PER_M
            corners = (left, row - 6), (left + PIXELS_PER_M, row + 6)
            cv2.rectangle(self.pixels, *corners, _INK if metre % 2 == 0 else (255, 255, 255), -1)
            cv2.rectangle(self.pixels, *corners, _INK, 1)
        _put(self.pixels, (_MARGIN_PX + 2 * PIXELS_PER_M + 12, row + 6), "2 m", _INK)
        note = "S: start   number: viewpoint   red: lap line and centre   green: route, its places"
        _put(self.pixels, (_MARGIN_PX + 4 * PIXELS_PER_M, row + 6), note, _INK, 0.5)


def _draw_fixtures(sheet: _Sheet, world: World) -> None:
    walls = {wall.name: wall for wall in world.walls}
    for fixture in world.fixtures:
        ax, ay, bx, by = walls[fixture.wall].segments[fixture.segment]
        length = float(walls[fixture.wall].lengths[fixture.segment])
        ux, uy = (bx - ax) / length, (by - ay) / length
        near, far = fixture.at_m - fixture.width_m / 2, fixture.at_m + fixture.width_m / 2
        ends = [(ax + ux * s + uy * 0.06, ay + uy * s - ux * 0.06) for s in (near, far)]
        sheet.line(ends[0], ends[1], fixture.rgb, 10)
        if fixture.kind != "radiator":
            middle = (ax + ux * fixture.at_m, ay + uy * fixture.at_m)
            sheet.label(middle, fixture.name or fixture.kind, (0.16 * uy, -0.16 * ux))


def _draw_route(sheet: _Sheet, route: Route) -> None:
    """A dotted line, and its places as rings with their names."""
    for x, y in route.sample(0.2):
        sheet.dot((float(x), float(y)), _ROUTE, 2)
    for place in route.places:
        sheet.dot((place.x_m, place.y_m), _ROUTE)
        sheet.label((place.x_m, place.y_m), place.name, (0.0, 0.26), _ROUTE)


def _off_walls(world: World, obstacle: Obstacle) -> Point:
    """Way from an obstacle's middle to where its name can be read: towards more room."""
    x, y = np.ptp(obstacle.corners, axis=0) / 2 + 0.05
    ways = np.array([(0.0, y), (0.0, -y), (x, 0.0), (-x, 0.0)])
    room = world.clearance(np.array([[obstacle.x_m, obstacle.y_m]]) + 1.5 * ways)
    way = ways[int(np.argmax(room))]
    return float(way[0]), float(way[1])


def _ahead(pose: Pose, distance_m: float) -> Point:
    c, s = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    return pose.x_m + distance_m * c, pose.y_m + distance_m * s


def _put(
    pixels: Picture, at: tuple[int, int], words: str, rgb: Colour, size: float = 0.55, px: int = 1
) -> None:
    cv2.putText(pixels, words, at, cv2.FONT_HERSHEY_SIMPLEX, size, rgb, px, cv2.LINE_AA)


def _write(path: Path, picture: Picture) -> None:
    if not cv2.imwrite(str(path), np.ascontiguousarray(picture[:, :, ::-1])):
        raise OSError(f"cannot write {path}")
