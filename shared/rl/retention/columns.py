"""Columns that several strategies share: descriptors and predictions, renewed as weights change."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from shared.rl.descriptor import BYTES, random_planes, signs_of, thumbnail
from shared.rl.retention.strategy import Situation, beyond

if TYPE_CHECKING:
    from shared.rl.engine import Progress
    from shared.rl.memory import Images

Ranks = npt.NDArray[np.int64]
Look = Callable[[Ranks, "Images", "Progress | None"], npt.NDArray[Any]]
"""(ranks, their images, what is told the progress) -> the values of these samples."""

DESCRIBED = (
    ("descriptor", "u1", (BYTES,)),
    ("described_by", "<u4"),  # kind and weights version of the descriptor; 0: none yet
)
PREDICTED = (
    ("predicted", "<f4"),  # Q(s, a), clipped
    ("predicted_by", "<u4"),  # weights version of it; 0: none yet
)
KINDS = ("maps", "fconn1", "first-maps", "thumbnail", "simhash")
FIXED = ("first-maps", "thumbnail", "simhash")
"""Kinds of descriptor that other weights do not change."""
KIND_SHIFT = 28
"""`described_by` holds the kind's place in `KINDS` in the bits from here on: 0 for maps."""


def renew(there: Situation, name: str, by: str, stamp: int, look: Look) -> bool:
    """Compute a column anew where another column, `by`, differs from `stamp`.

    Returns whether it did anywhere.
    """
    memory = there.memory
    outdated = np.flatnonzero(memory.rows[by] != stamp)
    total, done = len(memory), len(memory) - len(outdated)
    for some, images in memory.parts(outdated):
        memory.rows[name][some] = look(some, images, beyond(done, total, there.progress))
        memory.rows[by][some] = stamp
        done += len(some)
    return len(outdated) > 0


def renew_descriptors(there: Situation) -> bool:
    """Describe what no descriptor of the kind in force describes; return whether there was any."""
    kind = there.config.descriptor
    version = 1 if kind in FIXED else there.network.version
    stamp = KINDS.index(kind) << KIND_SHIFT | version
    return renew(there, "descriptor", "described_by", stamp, _describing(there))


def renew_predictions(there: Situation) -> bool:
    """Predict Q(s, a) of what the weights in force have not; return whether there was any."""
    network, actions = there.network, there.memory.rows["action"].copy()

    def look(ranks: Ranks, images: Images, progress: Progress | None) -> npt.NDArray[Any]:
        return network.values(images, actions[ranks], progress)

    return renew(there, "predicted", "predicted_by", network.version, look)


def errors(there: Situation) -> npt.NDArray[np.float64]:
    """Return r - Q(s, a) of all samples, predictions being up to date: float64 [n]."""
    rows = there.memory.rows
    return np.asarray(rows["reward"].astype(np.float64) - rows["predicted"])


def _describing(there: Situation) -> Look:
    """What makes descriptors of the kind in force."""
    kind, network = there.config.descriptor, there.network
    if kind == "thumbnail":
        return lambda _, images, __: thumbnail(images)
    if kind == "simhash":
        planes = random_planes(there.seed)
        return lambda _, images, __: signs_of(images, planes)
    if kind == "fconn1":
        return lambda _, images, progress: network.unit_descriptors(images, progress)
    if kind == "first-maps":
        return lambda _, images, progress: network.first(there.seed).descriptors(images, progress)
    return lambda _, images, progress: network.descriptors(images, progress)
