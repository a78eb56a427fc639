"""Strategies that thin out: the older of the two most alike samples goes, repeatedly.

All that stays then keeps its distance from all else, as far as that is possible.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from shared.rl.draws import generator
from shared.rl.retention.columns import DESCRIBED, Ranks, renew, renew_descriptors
from shared.rl.retention.strategy import Discard, Situation, Strategy, surplus
from shared.rl.similarity import Descriptors

if TYPE_CHECKING:
    from shared.rl.engine import Progress
    from shared.rl.memory import Images

Distances = Callable[[Ranks, int], npt.NDArray[Any]]
"""(ranks of k samples, start) -> their distances from all samples of rank `start` on, as floats
[k, n - start] of at most `FAR`. The array is overwritten."""
FAR = np.float32(1e30)
"""The distance of samples that must not be compared."""
ROWS = 512
"""Samples compared with all newer ones at a time."""
M_PER_RAD = 0.5
"""A difference of heading counts as this way."""
UNITS, PLANES = 128, 64
"""Outputs of FConn3, and planes that tell gradients apart."""


class MostAlike(Strategy):
    """Again and again the older of the two most alike samples goes, until floor(0.99 N) remain.

    Of pairs that are equally alike the one goes whose older sample is the oldest.
    """

    @abstractmethod
    def distances(self, there: Situation) -> Distances:
        """Return what computes distances. The columns are up to date."""

    def choose(self, there: Situation) -> Discard:
        """Choose the older ones of the most alike."""
        memory, changed = there.memory, self.renew(there)
        gone = older_of_most_alike(self.distances(there), len(memory), surplus(memory))
        return Discard(memory.capacity, memory.ids[gone], marked=changed)


class Coverage(MostAlike):
    """What stays covers the space of descriptors: two samples are alike if few bits differ."""

    columns = DESCRIBED

    def renew(self, there: Situation) -> bool:
        """Describe what the weights in force have not described."""
        return renew_descriptors(there)

    def distances(self, there: Situation) -> Distances:
        """Return what counts the bits that differ."""
        return hamming(there.memory.rows["descriptor"])


class CoveragePose(MostAlike):
    """What stays covers the places and headings of each world.

    Two samples of one world are alike if they were taken close by, in like directions. No robot
    knows its true pose, so this is an oracle, for measurement.
    """

    def distances(self, there: Situation) -> Distances:
        """Return what computes metres, plus 0.5 m a radian of heading; `FAR` between worlds."""
        rows = there.memory.rows
        world = rows["world"].copy()
        x, y, heading = (rows[name].astype(np.float64) for name in ("x_m", "y_m", "heading_rad"))
        heading = np.mod(heading, 2 * np.pi)

        def distances(ranks: Ranks, start: int) -> npt.NDArray[Any]:
            turned = np.abs(heading[ranks, np.newaxis] - heading[start:])
            np.minimum(turned, 2 * np.pi - turned, out=turned)
            found = (x[ranks, np.newaxis] - x[start:]) ** 2
            found += (y[ranks, np.newaxis] - y[start:]) ** 2
            np.sqrt(found, out=found)
            found += M_PER_RAD * turned
            found[world[ranks, np.newaxis] != world[start:]] = FAR
            return found

        return distances


class Gradients(MostAlike):
    """What stays would teach the network different things.

    Two samples are alike if the angle between their gradients is small.

    The gradient is that of (Q - r)^2 by the weights of the last layer: 2 (Q - r) h, with h the
    outputs of FConn3. Each sample keeps on which side of 64 planes it lies, drawn from the run's
    seed: two gradients differ in a share angle / pi of these bits on average. That takes 8 bytes
    where the gradient itself would take 512. Equalisation moves r towards Q and never past it, so
    the sides stay right until the weights change. After Aljundi et al., "Gradient based sample
    selection for online continual learning" (2019).
    """

    columns = (
        ("gradient_sides", "u1", (PLANES // 8,)),
        ("gradient_by", "<u4"),  # weights version of it; 0: none yet
    )

    def renew(self, there: Situation) -> bool:
        """Compute the sides of samples that the weights in force have not seen."""
        network, rows = there.network, there.memory.rows
        actions, rewards = rows["action"].copy(), rows["reward"].copy()
        planes = generator(there.seed, "gradients").standard_normal((UNITS, PLANES))

        def look(ranks: Ranks, images: Images, progress: Progress | None) -> npt.NDArray[Any]:
            hidden, values = network.hidden(images, actions[ranks], progress)
            return sides(hidden, values - rewards[ranks], planes)

        return renew(there, "gradient_sides", "gradient_by", network.version, look)

    def distances(self, there: Situation) -> Distances:
        """Return what counts the planes between two gradients."""
        return hamming(there.memory.rows["gradient_sides"])


def older_of_most_alike(distances: Distances, n: int, count: int) -> Ranks:
    """Return the ranks of the `count` of n samples that go, ascending.

    The sample that goes is always that with the least distance from a newer one. So each keeps its
    nearest newer sample, and looks for another one only when that goes.
    """
    gone = np.zeros(n, np.bool_)
    least, nearest = np.empty(n), np.empty(n, np.int64)
    for start in range(0, n, ROWS):
        block = np.arange(start, min(start + ROWS, n))
        least[block], nearest[block] = _nearest_newer(distances, block, gone)
    for _ in range(count):
        first = int(np.argmin(least))
        gone[first], least[first], nearest[first] = True, np.inf, -1
        bereft = np.flatnonzero(nearest == first)
        if len(bereft):
            least[bereft], nearest[bereft] = _nearest_newer(distances, bereft, gone)
    return np.flatnonzero(gone)


def sides(
    hidden: npt.NDArray[np.float32],
    errors: npt.NDArray[np.float32],
    planes: npt.NDArray[np.float64],
) -> npt.NDArray[np.uint8]:
    """Return on which side of each plane the gradients lie, packed: uint8 [n, planes / 8].

    hidden: h [n, units]; errors: Q - r [n]; planes: their normals [units, planes].
    """
    return np.packbits(errors[:, np.newaxis] * (hidden.astype(np.float64) @ planes) > 0.0, axis=1)


def hamming(packed: Descriptors) -> Distances:
    """Return what counts the bits in which packed rows uint8 [n, bytes] differ."""
    import torch

    bits = 8 * packed.shape[1]
    signs = torch.from_numpy(np.unpackbits(packed, axis=1).astype(np.float32) * 2.0 - 1.0)

    def distances(ranks: Ranks, start: int) -> npt.NDArray[Any]:
        products = signs[torch.from_numpy(ranks)] @ signs[start:].T  # whole numbers: exact
        return products.sub_(bits).mul_(-0.5).numpy()

    return distances


def _nearest_newer(
    distances: Distances, ranks: Ranks, gone: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[Any], Ranks]:
    """The least distance of each from a newer sample that has not gone, and the rank of that one.

    ranks: ascending. Of equally near ones the newest is taken: the older would go first.
    """
    start, end = int(ranks[0]), int(ranks[-1]) + 1
    found = distances(ranks, start)
    found[:, : end - start][np.arange(start, end) <= ranks[:, np.newaxis]] = FAR
    found[:, gone[start:]] = FAR
    nearest = found.shape[1] - 1 - np.argmin(found[:, ::-1], axis=1)
    return found[np.arange(len(ranks)), nearest], start + nearest


COVERAGE, COVERAGE_POSE, GRADIENTS = Coverage(), CoveragePose(), Gradients()
