"""Inference with fixed arithmetic: what a role predicts does not depend on who else asks."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from shared.facts import ACTION_COUNT
from shared.rl.descriptor import describe
from shared.rl.engine import Engine, Progress, TorchEngine
from shared.rl.network import HIDDEN, QNetwork, initialised, load_bytes, to_bytes

if TYPE_CHECKING:
    from shared.config import NetworkConfig, Numerics

Images = npt.NDArray[np.uint8]


class Predictor:
    """One version of the target network, ready to predict."""

    def __init__(self, network: NetworkConfig, numerics: Numerics) -> None:
        """Raises ValueError for unsettled numerics, ImportError for an engine not installed."""
        self.version = 0
        self._config, self._numerics = network, numerics
        self._network = QNetwork(network)
        self._engine = engine(numerics)
        self._firsts: dict[int, Predictor] = {}

    def load(self, version: int, data: bytes) -> None:
        """Become `version`, given as safetensors bytes. Raises ValueError if they do not fit."""
        load_bytes(self._network, data)
        self._engine.load(self._network)
        self.version = version

    def successor(self, version: int, data: bytes) -> Predictor:
        """Another predictor, of `version`; this one stays what it is. Raises like `load`."""
        other = copy.copy(self)  # the network is shared: weights only pass through it
        other._engine = engine(self._numerics)
        other.load(version, data)
        return other

    def all_values(
        self, images: Images, progress: Progress | None = None
    ) -> npt.NDArray[np.float32]:
        """Q(s, a) of all actions, clipped to [-1, 1] (A24, E8): float32 [n, 3]."""
        return self._engine.run(images, "values", progress)

    def values(
        self, images: Images, actions: npt.NDArray[np.uint8], progress: Progress | None = None
    ) -> npt.NDArray[np.float32]:
        """Q(s, a) of the given action of each image, clipped: float32 [n]."""
        every = self.all_values(images, progress)
        return every[np.arange(len(images)), actions]

    def descriptors(
        self, images: Images, progress: Progress | None = None
    ) -> npt.NDArray[np.uint8]:
        """Packed 120-bit descriptors uint8 [n, 15] (A29)."""
        return describe(self._engine.run(images, "sums", progress))

    def unit_descriptors(
        self, images: Images, progress: Progress | None = None
    ) -> npt.NDArray[np.uint8]:
        """Such descriptors made of the 128 units of FConn1, 8 a block: uint8 [n, 15]."""
        return describe(self._engine.run(images, "units", progress))

    def hidden(
        self, images: Images, actions: npt.NDArray[np.uint8], progress: Progress | None = None
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """FConn3 for the action of each image, float32 [n, 128], and unclipped Q, float32 [n]."""
        every = self._engine.run(images, "hidden", progress)
        of_actions = every.reshape(len(images), ACTION_COUNT, HIDDEN + 1)
        own = of_actions[np.arange(len(images)), actions]
        return own[:, :-1], own[:, -1]

    def first(self, seed: int) -> Predictor:
        """The predictor of version 1, as a run with this seed begins. It is made once."""
        if seed not in self._firsts:
            first = Predictor(self._config, self._numerics)
            first.load(1, to_bytes(initialised(self._config, seed)))
            self._firsts[seed] = first
        return self._firsts[seed]


def engine(numerics: Numerics) -> Engine:
    """The engine a role's numerics name. Raises ValueError or ImportError."""
    if not numerics.settled:
        raise ValueError(f"numerics must be settled before use, got {numerics}")
    if numerics.engine == "openvino" and numerics.device == "cpu":
        from shared.rl.openvino_engine import OpenVinoEngine

        return OpenVinoEngine(numerics)
    return TorchEngine(numerics)
