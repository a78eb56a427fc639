"""Descriptors against loops (A29, E17, E18)."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import torch
from builders import make_images
from hypothesis import given, settings
from hypothesis import strategies as st

from shared.rl.descriptor import (
    BITS,
    BYTES,
    block_sums,
    describe,
    random_planes,
    signs_of,
    threshold_bits,
    thumbnail,
    unit_sums,
)

FAST = settings(deadline=None, max_examples=80, derandomize=True)


def naive_bits(sums: list[float]) -> str:
    return "".join("1" if sums[i] > sums[j] else "0" for i in range(16) for j in range(i + 1, 16))


def bits_of(descriptor: np.ndarray) -> str:
    return "".join(f"{byte:08b}" for byte in descriptor)


@FAST
@given(st.lists(st.integers(-3, 3).map(float), min_size=16, max_size=16))
def test_each_pair_gives_one_bit_in_lexicographic_order_and_ties_give_zero(
    sums: list[float],
) -> None:
    found = describe(np.array([sums], np.float32))
    assert (found.shape, found.dtype) == ((1, 15), np.uint8)
    assert bits_of(found[0]) == naive_bits(sums)


def test_first_and_last_bits_are_the_first_and_last_pairs() -> None:
    sums = np.zeros((3, 16), np.float32)
    sums[0, 0] = 1.0  # beats the 15 others
    sums[1, 14] = 1.0  # beats only 15, as the last pair
    assert [bits_of(d) for d in describe(sums)] == [
        "1" * 15 + "0" * 105,
        "0" * 119 + "1",
        "0" * 120,
    ]


def test_sizes_are_those_of_the_thesis() -> None:
    assert (BITS, BYTES) == (120, 15)


def test_no_images_have_no_descriptors() -> None:
    assert describe(np.zeros((0, 16), np.float32)).shape == (0, 15)
    assert describe(np.zeros((0, 3), np.float32)).shape == (0, 15)


@pytest.mark.parametrize("filters", [16, 32, 64, 128])
def test_a_block_is_consecutive_channels_over_all_positions(filters: int) -> None:
    maps = torch.rand((3, filters, 9, 15), generator=torch.Generator().manual_seed(filters))
    found = block_sums(maps).numpy()
    per_block = filters // 16
    for image in range(3):
        for block in range(16):
            total = 0.0
            for channel in range(block * per_block, (block + 1) * per_block):
                total += sum(float(v) for v in maps[image, channel].flatten())
            assert found[image, block] == pytest.approx(total, rel=1e-5)


@pytest.mark.parametrize("filters", [4, 8])
def test_narrow_networks_cut_each_channel_into_vertical_stripes(filters: int) -> None:
    maps = torch.rand((2, filters, 9, 15), generator=torch.Generator().manual_seed(filters))
    found = block_sums(maps).numpy()
    assert found.shape == (2, 16)
    widths = {4: [4, 4, 4, 3], 8: [8, 7]}[filters]
    for image in range(2):
        for channel in range(filters):
            left = 0
            for stripe, width in enumerate(widths):
                total = sum(
                    float(maps[image, channel, row, column])
                    for row in range(9)
                    for column in range(left, left + width)
                )
                left += width
                block = channel * len(widths) + stripe
                assert found[image, block] == pytest.approx(total, rel=1e-5)


@pytest.mark.parametrize("filters", [5, 12, 20])
def test_other_widths_are_refused(filters: int) -> None:
    with pytest.raises(ValueError, match=str(filters)):
        block_sums(torch.zeros((1, filters, 9, 15)))


@pytest.mark.parametrize("channels_last", [False, True])
def test_memory_layout_of_the_maps_does_not_matter(channels_last: bool) -> None:
    maps = torch.arange(64 * 9 * 15, dtype=torch.float32).reshape(1, 64, 9, 15)
    if channels_last:
        maps = maps.to(memory_format=torch.channels_last)
    found = block_sums(maps).numpy()[0]
    assert list(found) == sorted(found)
    assert found[0] == sum(range(4 * 9 * 15))


def test_percent_become_whole_bits_as_the_thesis_counts_them() -> None:
    assert [threshold_bits(p) for p in range(1, 8)] == [1, 2, 3, 4, 6, 7, 8]
    assert threshold_bits(100) == 120


def test_a_block_of_units_is_eight_consecutive_ones() -> None:
    units = torch.arange(2 * 128, dtype=torch.float32).reshape(2, 128)
    expected = [[sum(range(8 * i, 8 * i + 8)) for i in range(k, k + 16)] for k in (0, 16)]
    assert unit_sums(units).tolist() == expected


def naive_thumbnail(image: np.ndarray) -> list[list[Fraction]]:
    """Area means 16 wide and 8 high, pixel by pixel, exactly."""

    def overlap(pixel: int, cell: int, size: Fraction) -> Fraction:
        return max(Fraction(0), min(pixel + 1, (cell + 1) * size) - max(pixel, cell * size))

    height, width = Fraction(50, 8), Fraction(75, 16)
    return [
        [
            sum(
                int(image[y, x]) * overlap(y, row, height) * overlap(x, column, width)
                for y in range(int(row * height), min(int((row + 1) * height) + 1, 50))
                for x in range(int(column * width), min(int((column + 1) * width) + 1, 75))
            )
            / (height * width)
            for column in range(16)
        ]
        for row in range(8)
    ]


def test_a_thumbnail_compares_exact_means_with_their_right_neighbours() -> None:
    images = make_images(3)
    images[2] = images[2] // 128  # many are close
    for image, found in zip(images, thumbnail(images), strict=True):
        means = naive_thumbnail(image)
        assert bits_of(found) == "".join(
            "1" if row[i] > row[i + 1] else "0" for row in means for i in range(15)
        )


def test_plain_images_have_no_bits_whatever_their_brightness() -> None:
    plain = np.repeat(np.array([0, 1, 77, 255], np.uint8), 50 * 75).reshape(4, 50, 75)
    assert not thumbnail(plain).any()
    assert not signs_of(plain, random_planes(1)).any()
    assert thumbnail(plain[:0]).shape == signs_of(plain[:0], random_planes(1)).shape == (0, 15)


def test_signs_are_those_of_the_projections_of_the_image_without_its_mean() -> None:
    images, planes = make_images(6), random_planes(3)
    assert set(np.unique(planes)) == {-1.0, 1.0}
    for image, found in zip(images, signs_of(images, planes), strict=True):
        free = image.reshape(-1) - image.mean()
        assert bits_of(found) == "".join("1" if free @ plane > 0.0 else "0" for plane in planes.T)
    darker = images // 2
    assert np.mean(signs_of(darker, planes) == signs_of(images, planes)) > 0.8
    assert not np.array_equal(random_planes(4), planes)
