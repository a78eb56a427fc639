"""A film of a drive: the network's image, its predictions, and the robot's way on the map."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image

from services.robot_driver.simulated.world import solids
from shared.errors import ConfigError
from shared.facts import ACTIONS, IMAGE_HEIGHT, IMAGE_WIDTH
from shared.messages import Observation, image_array

SIDE_PX = 360
"""Height of a frame, which is two squares wide: image and bars, and the map."""
ENLARGED, EDGE_PX, BAR_PX, WAY_PLACES = 4, 16, 24, 400
MAX_GIF_FRAMES = 2000
"""They are kept in memory until the end. Later ones are left out."""
INK, PAPER = (40, 44, 52), (247, 246, 242)
WAY, GOOD, BAD = (44, 110, 190), (40, 140, 80), (200, 60, 50)
Frame = npt.NDArray[np.uint8]


class Film:
    """Frames that are added one by one."""

    def __init__(self) -> None:
        self._mp4: cv2.VideoWriter | None = None
        self._gif: list[Image.Image] = []
        self._map = _Map("")

    def add(
        self, seen: Observation, values: Sequence[float], action: int | None, told: str = ""
    ) -> None:
        """Show an image, what is predicted for it, and what is done; action None: none of them."""
        if seen.world != self._map.world:
            self._map = _Map(seen.world)
        frame = np.full((SIDE_PX, 2 * SIDE_PX, 3), PAPER, np.uint8)
        size = (ENLARGED * IMAGE_WIDTH, ENLARGED * IMAGE_HEIGHT)
        grey = cv2.resize(image_array(seen.image), size, interpolation=cv2.INTER_NEAREST)
        frame[EDGE_PX : EDGE_PX + size[1], 30 : 30 + size[0]] = grey[:, :, np.newaxis]
        _draw_bars(frame, EDGE_PX + size[1] + 36, values, action, told)
        frame[:, SIDE_PX:] = self._map.draw(seen)
        if self._mp4 is not None:
            self._mp4.write(np.ascontiguousarray(frame[:, :, ::-1]))
        elif len(self._gif) < MAX_GIF_FRAMES:
            picture = Image.fromarray(frame).resize((SIDE_PX * 4 // 3, SIDE_PX * 2 // 3))
            self._gif.append(picture.quantize(64, Image.Quantize.FASTOCTREE))


@contextmanager
def filming(path: Path, frames_per_s: float) -> Iterator[Film]:
    """A film in a new file, `.mp4` or `.gif`, complete after the block. Raises ConfigError."""
    if path.suffix not in (".mp4", ".gif"):
        raise ConfigError(f"{path}: expected a name that ends in .mp4 or .gif")
    if path.exists():
        raise ConfigError(f"{path} exists already")
    film = Film()
    if path.suffix == ".mp4":
        code, size = cv2.VideoWriter.fourcc(*"mp4v"), (2 * SIDE_PX, SIDE_PX)
        film._mp4 = cv2.VideoWriter(str(path), code, frames_per_s, size)
        if not film._mp4.isOpened():
            raise ConfigError(f"{path}: cannot be written")
    try:
        yield film
    finally:
        if film._mp4 is not None:
            film._mp4.release()
        elif film._gif:
            first, *others = film._gif
            pause_ms = round(1000 / frames_per_s)
            first.save(path, save_all=True, append_images=others, duration=pause_ms, loop=0)


class _Map:
    """A world from above, and the way of the robot; an unknown world is 10 m wide."""

    def __init__(self, world: str) -> None:
        self.world = world
        self.way: list[tuple[float, float]] = []
        boxes = [
            cv2.boxPoints(((box.x_m, box.y_m), (box.length_m, box.width_m), box.heading_deg))
            for box in solids(world)
        ]
        corners = np.vstack(boxes or [np.array([(-5.0, -5.0), (5.0, 5.0)])])
        low, high = corners.min(axis=0), corners.max(axis=0)
        self._middle, size_m = (low + high) / 2, float((high - low).max())
        self._scale = (SIDE_PX - 2 * EDGE_PX) / size_m
        self._sheet = np.full((SIDE_PX, SIDE_PX, 3), PAPER, np.uint8)
        for box in boxes:
            cv2.polylines(self._sheet, [self._at(box)], True, INK, 2, cv2.LINE_AA)

    def draw(self, seen: Observation) -> Frame:
        """The map with the robot on it."""
        if self.way and math.dist(self.way[-1], (seen.x_m, seen.y_m)) > 1.0:
            self.way.clear()  # it was moved
        self.way = [*self.way[-WAY_PLACES:], (seen.x_m, seen.y_m)]
        turn = (math.cos(seen.heading_rad), math.sin(seen.heading_rad))
        nose = (seen.x_m + 0.5 * turn[0], seen.y_m + 0.5 * turn[1])
        sheet, way = self._sheet.copy(), self._at([*self.way, nose])
        cv2.polylines(sheet, [way], False, WAY, 2, cv2.LINE_AA)
        cv2.circle(sheet, way[-2].tolist(), 5, BAD if seen.bump else WAY, -1, cv2.LINE_AA)
        return sheet

    def _at(self, points: npt.ArrayLike) -> npt.NDArray[np.int32]:
        """Pixels [n, 2] of places in metres [n, 2]; y points up."""
        metres = (np.asarray(points, np.float64) - self._middle) * (self._scale, -self._scale)
        return np.asarray(np.round(metres + SIDE_PX / 2), np.int32)


def _draw_bars(
    frame: Frame, top: int, values: Sequence[float], action: int | None, told: str
) -> None:
    """A bar from the middle for each action, to the right if its prediction is above 0."""
    middle, half = 230, 100
    _text(frame, (30, top - 12), told)
    for number, (value, kind) in enumerate(zip(values, ACTIONS, strict=True)):
        tip = middle + round(half * max(-1.0, min(1.0, value)))
        corners = (middle, top), (tip, top + BAR_PX)
        cv2.rectangle(frame, *corners, GOOD if value >= 0 else BAD, -1)
        if number == action:
            box = (middle - half - 2, top - 2), (middle + half + 2, top + BAR_PX + 2)
            cv2.rectangle(frame, *box, INK, 2)
        _text(frame, (30, top + 17), kind.short)
        top += BAR_PX + 8
    cv2.line(frame, (middle, top - len(ACTIONS) * (BAR_PX + 8)), (middle, top), INK, 1)


def _text(frame: Frame, at: tuple[int, int], words: str) -> None:
    cv2.putText(frame, words, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, INK, 1, cv2.LINE_AA)
