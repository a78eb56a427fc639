"""Changes of the memory as messages, and what they do to a mirror."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from shared.columns import CHANGES
from shared.messages import Change
from shared.rl.memory import MIRROR, SampleStore


def change(
    number: int, last: bool, kind: Literal["append", "discard", "rewards"], **values: Any
) -> Change:
    """Return a part of change `number` with the arrays that its kind has (`columns.CHANGES`)."""
    return Change(number=number, last=last, kind=kind, **CHANGES[kind].encode(values))


def apply(samples: SampleStore, part: Change) -> None:
    """Apply one part of a change to a store of samples.

    Raises KeyError or ValueError when it does not fit the samples.
    """
    values = CHANGES[part.kind].decode(part)
    if part.kind == "discard":
        samples.remove(values["ids"])
    elif part.kind == "rewards":
        samples.set_rewards(values["ids"], values["rewards"])
    else:
        rows = np.zeros(len(values["ids"]), MIRROR)
        rows["id"], rows["action"], rows["reward"] = (
            values[name] for name in ("ids", "actions", "rewards")
        )
        samples.append(rows, values["images"])
