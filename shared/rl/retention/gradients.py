"""Gradients: what stays would teach the network different things.

After Aljundi et al., "Gradient based sample selection for online continual learning" (2019).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from shared.rl.draws import generator
from shared.rl.retention.columns import Ranks, renew
from shared.rl.retention.most_alike import Distances, MostAlike, hamming
from shared.rl.retention.strategy import Situation

if TYPE_CHECKING:
    from shared.rl.engine import Progress
    from shared.rl.memory import Images

UNITS, BITS = 128, 64


class Gradients(MostAlike):
    """Two samples are alike if the angle between their gradients is small.

    The gradient is that of (Q - r)^2 by the weights of the last layer: 2 (Q - r) h, with h the
    outputs of FConn3. Each sample keeps on which side of 64 planes it lies, drawn from the run's
    seed: two gradients differ in a share angle / pi of these bits on average. That takes 8 bytes
    where the gradient itself would take 512. Equalisation moves r towards Q and never past it, so
    the sides stay right until the weights change.
    """

    columns = (
        ("gradient_sides", "u1", (BITS // 8,)),
        ("gradient_by", "<u4"),  # weights version of it; 0: none yet
    )

    def renew(self, there: Situation) -> bool:
        """Compute the sides of samples that the weights in force have not seen."""
        network, rows = there.network, there.memory.rows
        actions, rewards = rows["action"].copy(), rows["reward"].copy()
        planes = generator(there.seed, "gradients").standard_normal((UNITS, BITS))

        def look(ranks: Ranks, images: Images, progress: Progress | None) -> npt.NDArray[Any]:
            hidden, values = network.hidden(images, actions[ranks], progress)
            return sides(hidden, values - rewards[ranks], planes)

        return renew(there, "gradient_sides", "gradient_by", network.version, look)

    def distances(self, there: Situation) -> Distances:
        """Return what counts the planes between two gradients."""
        return hamming(there.memory.rows["gradient_sides"])


def sides(
    hidden: npt.NDArray[np.float32],
    errors: npt.NDArray[np.float32],
    planes: npt.NDArray[np.float64],
) -> npt.NDArray[np.uint8]:
    """Return on which side of each plane the gradients lie, packed: uint8 [n, planes / 8].

    hidden: h [n, units]; errors: Q - r [n]; planes: their normals [units, planes].
    """
    return np.packbits(errors[:, np.newaxis] * (hidden.astype(np.float64) @ planes) > 0.0, axis=1)


STRATEGY = Gradients()
