"""Target networks of the versions in use: robots that act with one version share it."""

from weakref import WeakValueDictionary

from shared.config import NetworkConfig, Numerics
from shared.rl.predictor import Predictor


class Targets:
    """One predictor per version, kept as long as a robot acts with it."""

    def __init__(self, network: NetworkConfig, numerics: Numerics) -> None:
        self.none = Predictor(network, numerics)
        """What a robot has before its first weights: version 0, cannot predict."""
        self._in_use: WeakValueDictionary[int, Predictor] = WeakValueDictionary()

    def of(self, version: int, data: bytes) -> Predictor:
        """The predictor of a version, whose weights are `data`. Raises ValueError on a misfit."""
        found = self._in_use.get(version)
        if found is None:
            found = self._in_use[version] = self.none.successor(version, data)
        return found
