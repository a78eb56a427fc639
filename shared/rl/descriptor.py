"""Binary descriptors of images from the network's own features (section 3.5.1, Fig 3.7).

Two more look at the image alone, and other weights do not change them. All have 120 bits.
"""

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from shared.facts import IMAGE_BYTES, IMAGE_HEIGHT, IMAGE_WIDTH
from shared.rl.draws import generator

BLOCKS = 16
BITS = BLOCKS * (BLOCKS - 1) // 2
"""120 pair comparisons (A29, E17)."""
BYTES = BITS // 8
THUMBNAIL_HEIGHT, THUMBNAIL_WIDTH = 8, 16
_FIRST, _SECOND = np.triu_indices(BLOCKS, k=1)  # (0,1), (0,2) ... (14,15): lexicographic


def block_sums(maps: Tensor) -> Tensor:
    """Sums over 16 blocks of the MaxPool2 maps: [n, filters, 9, 15] to [n, 16].

    A block is filters / 16 consecutive channels, summed over all positions (E17): 4 of 64. Networks
    with fewer than 16 filters cut each channel into 16 / filters vertical stripes instead.
    """
    n, filters = maps.shape[:2]
    if filters % BLOCKS == 0:
        return maps.reshape(n, BLOCKS, -1).sum(dim=2)
    if BLOCKS % filters:
        raise ValueError(f"filters must divide {BLOCKS} or be a multiple of it, got {filters}")
    stripes = torch.tensor_split(maps, BLOCKS // filters, dim=3)
    return torch.stack([stripe.sum(dim=(2, 3)) for stripe in stripes], dim=2).reshape(n, BLOCKS)


def unit_sums(units: Tensor) -> Tensor:
    """Sums over 16 blocks of 8 consecutive units of FConn1: [n, 128] to [n, 16]."""
    return units.reshape(len(units), BLOCKS, -1).sum(dim=2)


def describe(sums: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """Descriptors of block sums [n, 16]: bit (i, j), i < j, is sum_i > sum_j; ties give 0 (E17).

    Returns uint8 [n, 15], the 120 bits packed most significant first.
    """
    sums = sums.reshape(-1, BLOCKS)
    return np.packbits(sums[:, _FIRST] > sums[:, _SECOND], axis=1)


def threshold_bits(percent: int) -> int:
    """A similarity threshold in percent of 120 bits as whole bits: floor(1.2 p) (E18)."""
    return BITS * percent // 100


def thumbnail(images: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Descriptors of images uint8 [n, 50, 75]: is a pixel brighter than its right neighbour?

    The pixels are those of an area mean 16 wide and 8 high, row by row. Returns uint8 [n, 15].
    """
    # Means but for a common factor: whole numbers below 2^24, so exact in float32.
    rows = _overlaps(IMAGE_HEIGHT, THUMBNAIL_HEIGHT).T
    means = rows @ images.astype(np.float32) @ _overlaps(IMAGE_WIDTH, THUMBNAIL_WIDTH)
    return np.packbits((means[:, :, :-1] > means[:, :, 1:]).reshape(-1, BITS), axis=1)


def random_planes(seed: int) -> npt.NDArray[np.float32]:
    """Return 120 random projections of an image, -1 or 1 for each pixel: float32 [pixels, 120]."""
    drawn = generator(seed, "simhash").integers(0, 2, (IMAGE_BYTES, BITS))
    return np.asarray(2 * drawn - 1, np.float32)


def signs_of(
    images: npt.NDArray[np.uint8], planes: npt.NDArray[np.float32]
) -> npt.NDArray[np.uint8]:
    """Descriptors of images uint8 [n, 50, 75] without their mean: the signs of the projections.

    planes: see `random_planes`. Returns uint8 [n, 15]; a projection of 0 gives 0.
    """
    pixels = images.reshape(-1, len(planes)).astype(np.float32)
    # Whole numbers throughout: below 2^24 in float32, where each sum is exact, then in int64.
    products = (pixels @ planes).astype(np.int64)
    brightness = pixels.sum(axis=1).astype(np.int64)
    means = np.outer(brightness, planes.sum(axis=0).astype(np.int64))
    return np.packbits(len(planes) * products > means, axis=1)


def _overlaps(pixels: int, cells: int) -> npt.NDArray[np.float32]:
    """Lengths that pixels and cells share when both divide one line: float32 [pixels, cells].

    A pixel is `cells` long and a cell is `pixels` long, so all lengths are whole numbers.
    """
    pixel, cell = np.arange(pixels)[:, np.newaxis] * cells, np.arange(cells) * pixels
    overlaps = np.minimum(pixel + cells, cell + pixels) - np.maximum(pixel, cell)
    return np.asarray(np.maximum(overlaps, 0), np.float32)
