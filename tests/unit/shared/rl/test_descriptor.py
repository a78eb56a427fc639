"""Descriptors against loops (A29, E17, E18)."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from shared.rl.descriptor import BITS, BYTES, block_sums, describe, threshold_bits

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
