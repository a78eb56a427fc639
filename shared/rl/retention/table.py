"""The strategies of retention. A new one is a file beside this one and a row here.

The configuration reads this file, so it needs the standard library only.
"""

from __future__ import annotations

from typing import NamedTuple


class Row(NamedTuple):
    """Where a strategy is defined, and what records say of it."""

    module: str
    """File in this folder whose `STRATEGY` it is."""
    tells: tuple[str, ...] = ()
    """Names of the whole numbers that its discards tell, each a column of `episodes.csv`."""
    describes: bool = False
    """Whether it compares descriptors, of which `memory.descriptor` chooses the kind."""


SEARCH = ("last_resort", "recomputed", "threshold_percent")


STRATEGIES = {
    "rmm": Row("rmm", tells=SEARCH, describes=True),
    "normm": Row("normm"),
    "reservoir": Row("reservoir"),
    "quotas": Row("quotas"),
    "quotas-reservoir": Row("quotas_reservoir"),
    "random": Row("chance"),
    "half": Row("half"),
    "worlds": Row("worlds"),
    "coverage": Row("coverage", describes=True),
    "coverage-pose": Row("coverage_pose"),
    "surprise": Row("surprise"),
    "loss-reservoir": Row("loss_reservoir"),
    "gradients": Row("gradients"),
    "novelty": Row("novelty", tells=SEARCH, describes=True),
    "rmm-total": Row("rmm_total", tells=SEARCH, describes=True),
}
TELLS = tuple(dict.fromkeys(name for row in STRATEGIES.values() for name in row.tells))
"""What any strategy tells. It is 0 while a strategy is in force that tells nothing of that name."""
