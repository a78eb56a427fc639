"""Coverage of true poses: what stays covers the places and headings of each world.

No robot could do so, which knows its odometry alone: an oracle, for measurement.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from shared.rl.retention.most_alike import FAR, Distances, MostAlike, Ranks
from shared.rl.retention.strategy import Situation

M_PER_RAD = 0.5
"""A difference of heading counts as this way."""


class CoveragePose(MostAlike):
    """Two samples of one world are alike if they were taken close by, in like directions."""

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


STRATEGY = CoveragePose()
