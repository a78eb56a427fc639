"""Ways of drives: read as written, nothing else read, drawn with all that happened."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.text import Annotation

from experiments.drives import routes
from experiments.drives.routes import Event, Route
from experiments.drives.traces import Trace
from services.robot_driver.simulated.world import load_world
from shared.errors import StateError

DRIVE = Trace(
    world="plus",
    bumps=np.array([False, True, False]),
    places_m=np.array([[3.8, 0.0], [3.8, 0.15], [4.0, 0.0], [4.1, 0.1]]),
    headings_rad=np.array([math.pi / 2, math.pi / 2, 0.4, 0.4]),
    way_m=np.array([0.15, 0.05, 0.14]),
    laps_left=1,
    laps_right=2,
)


def test_a_route_comes_back_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "route-test.npz"
    events = (Event(1, 0, "begins"), Event(2, 2, "a bump, ü"))
    routes.write(path, Route(DRIVE, events))
    found = routes.read(path)
    assert found.events == events
    for name, value in vars(DRIVE).items():
        assert np.array_equal(getattr(found.trace, name), value), name


@pytest.mark.parametrize(
    "wrong",
    [
        replace(DRIVE, places_m=DRIVE.places_m[:-1]), replace(DRIVE, way_m=np.zeros(4)),
        replace(DRIVE, places_m=DRIVE.places_m[:, :1]),
        replace(DRIVE, places_m=DRIVE.places_m + math.nan),
        replace(DRIVE, headings_rad=DRIVE.headings_rad.astype(np.int64)),
    ],
)  # fmt: skip
def test_arrays_that_do_not_fit_are_refused(wrong: Trace, tmp_path: Path) -> None:
    path = tmp_path / "route.npz"
    routes.write(path, Route(wrong))
    with pytest.raises(StateError, match=r"route\.npz: .*expected"):
        routes.read(path)


@pytest.mark.parametrize("content", [None, b"", b"no zip", "pickled", "other"])
def test_what_is_no_route_is_refused_in_one_line(
    content: bytes | str | None, tmp_path: Path
) -> None:
    path = tmp_path / "route.npz"
    if content == "pickled":
        np.savez(path, bumps=np.array([{}], object), laps=np.array([0, 0]))
    elif content == "other":
        np.savez(path, other=np.zeros(3))
    elif isinstance(content, bytes):
        path.write_bytes(content)
    with pytest.raises(StateError, match=r"route\.npz: not the route of a drive"):
        routes.read(path)


def test_bumps_are_where_the_robot_touched_not_where_it_was_afterwards() -> None:
    assert routes.bump_places(DRIVE) == pytest.approx(np.array([[3.8, 0.2]]))


def test_pictures_show_way_and_bumps_on_the_map(tmp_path: Path) -> None:
    world = load_world("plus")
    unmoved = replace(DRIVE, bumps=np.zeros(3, np.bool_), places_m=np.full((4, 2), 3.8))
    pictures = []
    for name, traces in (("one", [DRIVE]), ("two", [DRIVE, unmoved]), ("none", [unmoved])):
        routes.figure(world, traces, name).savefig(tmp_path / f"{name}.png")
        pictures.append(cv2.imread(str(tmp_path / f"{name}.png")))
    one, _, none = pictures
    assert one.shape[1] == round(routes.WIDTH_IN * routes.DPI)

    def orange(picture: np.ndarray) -> int:
        b, g, r = (picture[..., k].astype(int) for k in range(3))
        return int(((r > 200) & (abs(g - 94) < 20) & (b < 30)).sum())

    assert orange(one) > orange(none) + 20


def test_events_stand_as_numbers_on_the_map() -> None:
    events = (Event(1, 0, "begins"), Event(2, 3, "ends"))
    (axes,) = routes.figure(load_world("plus"), [DRIVE], "Plus", events).axes
    marks = [mark for mark in axes.texts if isinstance(mark, Annotation)]
    assert [(mark.get_text(), mark.xy) for mark in marks] == [("1-2", (3.8, 0.0))]


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        ([], ""),
        ([3], "3"),
        ([3, 4], "3-4"),
        ([1, 3, 4, 5, 9], "1, 3-5, 9"),
        ([1, 3, 5, 7], "1, 3, 5 ..."),
    ],
)
def test_neighbouring_numbers_are_told_as_one(numbers: list[int], text: str) -> None:
    assert routes.ranges(numbers) == text


def test_events_close_to_each_other_share_a_label() -> None:
    far = replace(DRIVE, places_m=np.array([[0.0, 0.0], [0.1, 0.0], [5.0, 0.0], [0.2, 0.0]]))
    events = [Event(1, 0, ""), Event(2, 1, ""), Event(3, 2, ""), Event(4, 3, "")]
    assert routes.gathered(far, events) == [((0.0, 0.0), [1, 2, 4]), ((5.0, 0.0), [3])]
