"""Values of many samples as bytes and back: types and shapes of episodes and changes stand here."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from shared.facts import IMAGE_SHAPE


class Columns:
    """Fields of a message, each the little-endian bytes of one value for every sample."""

    def __init__(self, **types: npt.DTypeLike) -> None:
        self._types = {name: np.dtype(kind) for name, kind in types.items()}

    @property
    def names(self) -> frozenset[str]:
        """Names of the fields."""
        return frozenset(self._types)

    def encode(self, values: Mapping[str, Any]) -> dict[str, bytes]:
        """Return the bytes of arrays, or sequences, [n, *shape of a value]."""
        return {
            name: np.ascontiguousarray(values[name], kind.base).tobytes()
            for name, kind in self._types.items()
        }

    def decode(self, message: object) -> dict[str, npt.NDArray[Any]]:
        """Return read-only arrays [n, *shape of a value] of a message's bytes."""
        return {
            name: np.frombuffer(getattr(message, name), kind.base).reshape(-1, *kind.shape)
            for name, kind in self._types.items()
        }

    def check(self, message: object, n: int, what: str = "") -> None:
        """Raise ValueError where the bytes are not those of n samples. `what` precedes its text."""
        for name, kind in self._types.items():
            size = len(getattr(message, name))
            if size != n * kind.itemsize:
                raise ValueError(f"{what}{name}: expected {n} x {kind.itemsize} bytes, got {size}")


IMAGE = np.dtype(("u1", IMAGE_SHAPE))
EPISODE = Columns(
    images=IMAGE,
    sample_actions="u1",
    sample_rewards="<f4",
    sample_steps="<u4",
    sample_episodes="<u4",
    sample_versions="<u4",
    sample_worlds="u1",
    sample_by="u1",
    positions=np.dtype(("<f4", 3)),
)
"""The samples of an `Episode`."""
CHANGES = {
    "append": Columns(ids="<u8", images=IMAGE, actions="u1", rewards="<f4"),
    "discard": Columns(ids="<u8"),
    "rewards": Columns(ids="<u8", rewards="<f4"),
}
"""The samples of a `Change` by its kind. Fields that a kind lacks are empty."""
