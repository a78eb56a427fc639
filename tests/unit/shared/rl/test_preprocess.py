"""Preprocessing (A22, E29) against a naive implementation in exact arithmetic."""

from fractions import Fraction
from math import floor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared.facts import IMAGE_SHAPE
from shared.rl.preprocess import PREPROCESS_VERSION, preprocess

HALF = Fraction(1, 2)


def random_frame(height: int, width: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


def coverage(source: int, target: int) -> list[list[tuple[int, Fraction]]]:
    """For each target cell: source cells and the share of the target cell that each covers."""
    scale = Fraction(source, target)
    cells = []
    for i in range(target):
        low, high = i * scale, (i + 1) * scale
        cell = []
        for k in range(floor(low), min(source, floor(high) + 1)):
            overlap = min(high, Fraction(k + 1)) - max(low, Fraction(k))
            if overlap > 0:
                cell.append((k, overlap / scale))
        cells.append(cell)
    return cells


def naive_pixel(frame: np.ndarray, row: list, column: list) -> int:
    """One pixel in exact arithmetic, each of the two steps rounded half up."""
    mean = [
        floor(sum(int(frame[y, x, c]) * wy * wx for y, wy in row for x, wx in column) + HALF)
        for c in range(3)
    ]
    return floor(Fraction(4899 * mean[0] + 9617 * mean[1] + 1868 * mean[2], 2**14) + HALF)


@pytest.mark.parametrize("size", [(720, 1280), (600, 800), (480, 641), (100, 150), (7, 5), (1, 1)])
def test_a_frame_becomes_area_means_in_exact_arithmetic(size: tuple[int, int]):
    frame = random_frame(*size, 1)
    image = preprocess(frame)
    rows, columns = coverage(size[0], 50), coverage(size[1], 75)
    for y, x in ((0, 0), (0, 74), (49, 0), (49, 74), (25, 37), (13, 61)):
        assert int(image[y, x]) == naive_pixel(frame, rows[y], columns[x])


def test_the_largest_picture_does_not_overflow():
    assert np.all(preprocess(np.full((4096, 4096, 3), 255, np.uint8)) == 255)


def test_it_agrees_with_the_area_resize_of_opencv():
    cv2 = pytest.importorskip("cv2")
    frame = random_frame(600, 800, 3)
    theirs = cv2.resize(frame, (75, 50), interpolation=cv2.INTER_AREA)
    assert np.abs(preprocess(frame).astype(int) - preprocess(theirs)).max() <= 1


def test_a_frame_of_the_right_size_is_only_turned_grey_rounding_half_up():
    frame = random_frame(50, 75, 2)
    exact = frame.astype(np.int64) @ np.array([4899, 9617, 1868])
    expected = [[floor(Fraction(int(v), 2**14) + Fraction(1, 2)) for v in row] for row in exact]
    assert np.array_equal(preprocess(frame), np.array(expected))


@pytest.mark.parametrize("size", [(50, 75), (100, 150), (720, 1280), (1080, 1920), (7, 5)])
def test_shape_type_and_plain_greys_are_kept(size: tuple[int, int]):
    for level in (0, 1, 127, 254, 255):
        image = preprocess(np.full((*size, 3), level, np.uint8))
        assert image.shape == IMAGE_SHAPE
        assert image.dtype == np.uint8
        assert np.all(image == level)


def test_primary_colours_have_their_bt601_luma():
    for channel, luma in enumerate((76, 150, 29)):
        frame = np.zeros((50, 75, 3), np.uint8)
        frame[..., channel] = 255
        assert np.all(preprocess(frame) == luma)


@given(seed=st.integers(0, 2**16), shade=st.integers(0, 255))
@settings(max_examples=20, deadline=None)
def test_result_lies_between_darkest_and_brightest(seed: int, shade: int):
    frame = random_frame(100, 160, seed) // 2 + shade // 2
    image = preprocess(frame)
    assert frame.min() <= image.min() <= image.max() <= frame.max()


def test_pixels_of_this_version_never_change():
    """A changed value here needs a new PREPROCESS_VERSION: stored images would differ."""
    y, x, c = np.mgrid[0:90, 0:160, 0:3]
    frame = ((7 * y + 3 * x + 50 * c) % 256).astype(np.uint8)
    image = preprocess(frame)
    assert PREPROCESS_VERSION == 2
    assert int(image.sum(dtype=np.int64)) == GOLDEN_SUM
    assert image[10, ::15].tolist() == GOLDEN_ROW


GOLDEN_SUM = 480362
GOLDEN_ROW = [172, 88, 108, 175, 64]


@pytest.mark.parametrize(
    "frame",
    [
        np.zeros((50, 75), np.uint8),
        np.zeros((50, 75, 4), np.uint8),
        np.zeros((50, 75, 3), np.float32),
        np.zeros((0, 75, 3), np.uint8),
    ],
)
def test_other_shapes_and_types_are_refused(frame: np.ndarray):
    with pytest.raises(ValueError, match="expected a uint8"):
        preprocess(frame)
