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


STRATEGIES = {
    "rmm": Row("rmm", tells=("last_resort", "recomputed", "threshold_percent")),
    "normm": Row("normm"),
    "reservoir": Row("reservoir"),
    "quotas": Row("quotas"),
    "quotas-reservoir": Row("quotas_reservoir"),
}
TELLS = tuple(name for row in STRATEGIES.values() for name in row.tells)
"""What any strategy tells. It is 0 while a strategy is in force that tells nothing of that name."""
