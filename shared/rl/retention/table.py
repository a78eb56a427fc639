"""The strategies of retention. A new one is a file beside this one and a row here.

The configuration reads this file, so it needs the standard library only.
"""

from typing import NamedTuple


class Row(NamedTuple):
    """Where a strategy is defined, and what records say of it."""

    module: str
    """File in this folder that has it."""
    name: str = "STRATEGY"
    """What it is called there."""
    tells: tuple[str, ...] = ()
    """Names of the whole numbers that its discards tell, each a column of `episodes.csv`."""
    describes: bool = False
    """Whether it compares descriptors, of which `memory.descriptor` chooses the kind."""


SEARCH = ("last_resort", "recomputed", "threshold_percent")


STRATEGIES = {
    "rmm": Row("rmm", tells=SEARCH, describes=True),
    "normm": Row("least_worth", "NORMM"),
    "reservoir": Row("least_worth", "RESERVOIR"),
    "quotas": Row("least_worth", "QUOTAS"),
    "quotas-reservoir": Row("least_worth", "QUOTAS_RESERVOIR"),
    "random": Row("least_worth", "RANDOM"),
    "half": Row("least_worth", "HALF"),
    "worlds": Row("least_worth", "WORLDS"),
    "coverage": Row("most_alike", "COVERAGE", describes=True),
    "coverage-pose": Row("most_alike", "COVERAGE_POSE"),
    "surprise": Row("least_worth", "SURPRISE"),
    "loss-reservoir": Row("least_worth", "LOSS_RESERVOIR"),
    "gradients": Row("most_alike", "GRADIENTS"),
    "novelty": Row("rmm", "NOVELTY", tells=SEARCH, describes=True),
    "rmm-total": Row("rmm", "RMM_TOTAL", tells=SEARCH, describes=True),
}
TELLS = tuple(dict.fromkeys(name for row in STRATEGIES.values() for name in row.tells))
"""What any strategy tells. It is 0 while a strategy is in force that tells nothing of that name."""
