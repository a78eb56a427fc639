"""`corridor world ...`: what they print, what they refuse, what they draw."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from services.cli import main as cli
from services.robot_driver.atlas.views import PIXELS_PER_M, draw_map
from services.robot_driver.simulated.world import WORLDS, World, load_world

PLUS = (WORLDS / "plus.toml").read_text(encoding="utf-8")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def own(text: str, name: str = "attic") -> Path:
    """A world file in `worlds/`."""
    Path("worlds").mkdir()
    path = Path("worlds") / f"{name}.toml"
    path.write_text(text.replace('name = "plus"', f'name = "{name}"'), encoding="utf-8")
    return path


def test_list_names_all_worlds_with_size_laps_and_file(capsys: pytest.CaptureFixture[str]):
    own(PLUS)
    assert cli.main(["world", "list"]) == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    assert set(lines) == {"attic", "i16c", "minus", "plus"}
    assert "9.8 x 9.8 m" in lines["plus"]
    assert " no laps " in lines["minus"]
    assert " no laps " not in lines["plus"]
    assert "worlds/attic.toml" in lines["attic"]
    assert load_world("i16c").title in lines["i16c"]


def test_check_prints_each_problem_on_a_line_and_ends_with_1(capsys: pytest.CaptureFixture[str]):
    crossing = own(PLUS.replace("[2.7, 0.9], [2.7, -0.9]", "[5.2, 0.9], [5.2, -0.9]").replace(
        "x_m = 3.8\ny_m = 0.0", "x_m = 3.8\ny_m = 2.0"
    ))  # fmt: skip
    for name in ("attic", str(crossing)):
        assert cli.main(["world", "check", name]) == 1
        lines = capsys.readouterr().out.splitlines()
        assert len(lines) == 2
        assert all("'outer' segment 0 and 'island' segment" in line for line in lines)


def test_check_prints_why_a_file_cannot_be_read(capsys: pytest.CaptureFixture[str]):
    own(PLUS.replace("height_m = 2.6", "height_m = -1.0"))
    assert cli.main(["world", "check", "attic"]) == 1
    assert capsys.readouterr().out.startswith("attic.toml: height_m: ")


@pytest.mark.parametrize("command", ["check", "render"])
def test_worlds_that_are_nowhere_are_refused(command: str, capsys: pytest.CaptureFixture[str]):
    assert cli.main(["world", command, "maze"]) == 2
    assert capsys.readouterr().err == (
        "corridor: no world named 'maze'; there are: i16c, minus, plus\n"
    )


def test_render_writes_a_map_views_and_images(capsys: pytest.CaptureFixture[str]):
    assert cli.main(["world", "render", str(own(PLUS)), "--out", "pictures"]) == 0
    names = {path.name for path in Path("pictures").iterdir()}
    assert names == {"map.png"} | {f"{k}-{i}.png" for k in ("view", "image") for i in range(1, 9)}
    assert cv2.imread("pictures/view-1.png").shape == (360, 640, 3)


def test_obstacles_starts_and_route_are_drawn_where_they_are():
    full = load_world("i16c")
    tree = full.model_dump()
    drawn = draw_map(full, 0.225, []).astype(int)
    x0, _, _, y1 = full.bounds

    def changed(part: str, empty: object, x: float, y: float) -> bool:
        """Whether a part changes the map near a place."""
        bare = draw_map(World.model_validate({**tree, part: empty}), 0.225, []).astype(int)
        margin = (drawn.shape[0] - (y1 - full.bounds[1]) * PIXELS_PER_M) / 2
        row, column = (round(margin + d * PIXELS_PER_M) for d in (y1 - y, x - x0))
        near = np.s_[row - 6 : row + 7, column - 6 : column + 7]
        assert bare.shape == drawn.shape
        return bool(np.any(bare[near] != drawn[near]))

    crate = full.obstacles[0]
    assert changed("obstacles", (), crate.x_m, crate.y_m)
    assert changed("route", None, 12.5, 0.0)
    other = [{"x_m": 8.0, "y_m": 5.0, "heading_deg": 0.0}]
    assert changed("starts", other, full.starts[1].x_m, full.starts[1].y_m)
