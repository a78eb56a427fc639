"""Films of recordings and of drives: as many frames as there should be, and what is on them."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
from builders import make_observation
from PIL import Image

from services.cli import main as cli
from services.recorder.recording import Origin, RecordingWriter
from services.recorder.tap import Heard
from services.robot_driver.atlas.film import SIDE_PX, filming
from shared.codec import encode
from shared.config import ActorNumerics, Config
from shared.keys import ACTION, OBSERVATION
from shared.messages import Action
from shared.rl.network import initialised, to_bytes
from shared.settings import claim

CONFIG = Config.model_validate({"network": {"filters": 4}})


def video(*words: object) -> int:
    return cli.main(["video", *map(str, words)])


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "drive.mcap"
    with RecordingWriter(path, Origin(CONFIG, ActorNumerics())) as writer:
        for number in range(40):
            seen = make_observation(number, x_m=4.2, y_m=-2.0 + 0.1 * number, heading_rad=1.5)
            action = Action(
                robot=seen.robot, actor_life="b" * 12, robot_life=seen.life, sequence=number,
                action=number % 3, by="network", values=(0.9, -0.5, 0.0), weights_version=1,
                episode=number,
            )  # fmt: skip
            writer.add(Heard(OBSERVATION, seen.robot, number, encode(seen)))
            writer.add(Heard(ACTION, seen.robot, number, encode(action)))
    return path


def test_parts_of_a_recording_become_a_gif(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "x.gif"
    assert video(recording, "--out", out, "--frames", 12, "--parts", 3, "--speed", 5) == 0
    with Image.open(out) as gif:
        assert (gif.n_frames, gif.info["duration"]) == (12, 50)
        assert gif.size == (SIDE_PX * 4 // 3, SIDE_PX * 2 // 3)
    assert "x.gif: 0.0 MB" in capsys.readouterr().out


def test_a_drive_with_the_network_of_a_run_becomes_an_mp4(tmp_path: Path) -> None:
    run, out = tmp_path / "run", tmp_path / "lap.mp4"
    claim(run, CONFIG)
    (run / "weights.safetensors").write_bytes(to_bytes(initialised(CONFIG.network, seed=3)))
    assert video(run, "--out", out, "--world", "minus", "--frames", 8) == 0
    film = cv2.VideoCapture(str(out))
    frames = list(
        itertools.takewhile(lambda frame: frame is not None, (film.read()[1] for _ in range(99)))
    )
    assert [frame.shape for frame in frames] == [(SIDE_PX, 2 * SIDE_PX, 3)] * 8
    assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(16.0)
    film.release()


def test_a_frame_shows_image_bars_and_way(tmp_path: Path) -> None:
    path = tmp_path / "x.gif"
    with filming(path, 4.0) as film:
        for number in range(3):
            film.add(make_observation(number, x_m=4.2, y_m=0.2 * number), (0.9, -0.5, 0.0), 0)
    with Image.open(path) as gif:
        gif.seek(2)
        frame = np.asarray(gif.convert("RGB")).astype(int)
    red, green, blue = (frame[:, :, channel] for channel in range(3))
    left, right = np.s_[:, : frame.shape[1] // 2], np.s_[:, frame.shape[1] // 2 :]
    assert (green - red)[left].max() > 60  # the bar of a good prediction
    assert (red - green)[left].max() > 60  # that of a bad one
    assert (blue - red)[right].max() > 60  # the robot and its way


def test_what_cannot_be_filmed_is_said_in_one_line(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert video(recording, "--out", tmp_path / "x.avi") == 2
    assert video(recording, "--out", recording.with_suffix(".mp4"), "--frames", 1) == 0
    assert video(recording, "--out", recording.with_suffix(".mp4")) == 2
    assert video(tmp_path / "none.mcap", "--out", tmp_path / "y.gif") == 2
    said = capsys.readouterr().err.splitlines()
    assert "expected a name that ends in .mp4 or .gif" in said[0]
    assert "exists already" in said[1]
    assert "there is no such file" in said[2]
