"""Strategies that give each sample a worth: of each part of the memory, those of least worth go.

They differ in what a sample is worth, and in the parts: the whole memory, one part for each action,
or one for each world.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from shared.rl.draws import uniform
from shared.rl.retention.columns import PREDICTED, errors, renew_predictions
from shared.rl.retention.strategy import (
    Discard,
    Floats,
    Situation,
    Strategy,
    chances,
    kept_in_total,
    lowest,
    surplus,
    surplus_by_action,
)

if TYPE_CHECKING:
    from shared.rl.memory import ReplayMemory

Ints = npt.NDArray[np.int64]
LEAST_LOSS = 1e-3
"""Added to each loss, so that a sample predicted exactly is not the certain next to go."""


class LeastWorth(Strategy):
    """The samples of least worth go, of equal ones the older, until floor(0.99 N) remain."""

    @abstractmethod
    def worth(self, there: Situation) -> Floats:
        """Return what each sample is worth: float64 [n]. The columns are up to date."""

    def losing(self, memory: ReplayMemory) -> Iterator[tuple[Ints, int]]:
        """Yield the ranks of each part that must lose samples, and how many."""
        yield np.arange(len(memory)), surplus(memory)

    def choose(self, there: Situation) -> Discard:
        """Choose the samples of least worth."""
        memory, changed = there.memory, self.renew(there)
        worth = self.worth(there)
        gone = [own[lowest(worth[own], count)] for own, count in self.losing(memory)]
        return Discard(memory.capacity, memory.ids[np.sort(np.concatenate(gone))], marked=changed)


class NoRMM(LeastWorth):
    """NoRMM: the oldest samples go, whatever they show (A28)."""

    def worth(self, there: Situation) -> Floats:
        """The newer, the more."""
        return np.arange(len(there.memory), dtype=np.float64)


class Reservoir(LeastWorth):
    """Of everything that ever came, each sample stays with the same probability.

    A sample draws its chance once, from its insertion number. So what stays is a fair draw from all
    samples so far, however often the memory was reduced (Vitter, algorithm R, with a fixed key).
    """

    def worth(self, there: Situation) -> Floats:
        """The chances of all samples."""
        return chances(there.seed, there.memory.ids)


class Half(Reservoir):
    """The newest floor(0.99 N) / 2 stay, and of the older ones those whose chances are highest.

    Among the newest nothing is chosen, so the rest is a fair draw from all that is older.
    """

    def worth(self, there: Situation) -> Floats:
        """The chances of all samples, and more for the newest."""
        worth = super().worth(there)
        worth[-(kept_in_total(there.memory.capacity) // 2) :] = 1.0  # every chance is below 1
        return worth


class Random(LeastWorth):
    """At each discard, each stored sample goes with the same probability.

    So the past fades: what has seen k N samples come after it is left with probability e^-k.
    """

    def worth(self, there: Situation) -> Floats:
        """A draw for each sample, another one at each discard."""
        role = f"retention, draw {self._draws(there)}"
        return uniform(there.seed, role, there.memory.ids)

    def choose(self, there: Situation) -> Discard:
        """Choose by chance, and count the discard."""
        return replace(super().choose(there), keep={"random_draws": self._draws(there) + 1})

    @staticmethod
    def _draws(there: Situation) -> int:
        return there.memory.kept.get("random_draws", 0)


class _OfActions(LeastWorth):
    """Only actions above N / 3 lose samples, down to 99 % of N / 3 (A33 alone)."""

    def losing(self, memory: ReplayMemory) -> Iterator[tuple[Ints, int]]:
        """Yield the samples of each such action."""
        for action, count in surplus_by_action(memory, memory.capacity).items():
            yield np.flatnonzero(memory.rows["action"] == action), count


class Quotas(_OfActions, NoRMM):
    """Of each action above its share of the memory, the oldest samples go."""


class QuotasReservoir(_OfActions, Reservoir):
    """Of each action above its share of the memory, samples go by chance."""


class Worlds(Reservoir):
    """An equal part of the memory for each world, and a reservoir in each part.

    Strategies are not told in which world a sample arose; this one is. The quotas add up to
    floor(0.99 N). A world with fewer samples leaves the rest to the others.
    """

    def losing(self, memory: ReplayMemory) -> Iterator[tuple[Ints, int]]:
        """Yield the samples of each world, and how many are above its quota."""
        worlds = memory.rows["world"].copy()
        counts = np.bincount(worlds)
        for world, kept in enumerate(equal_quotas(counts, kept_in_total(memory.capacity))):
            yield np.flatnonzero(worlds == world), int(counts[world]) - kept


class Surprise(LeastWorth):
    """What stays is what the network in force predicts worst: by |r - Q(s, a)|.

    The prediction is kept with each sample, not the error: rewards change as they are equalised.
    """

    columns = PREDICTED

    def renew(self, there: Situation) -> bool:
        """Predict what the weights in force have not predicted."""
        return renew_predictions(there)

    def worth(self, there: Situation) -> Floats:
        """The error of each prediction."""
        return np.abs(errors(there))


class LossReservoir(Surprise):
    """A reservoir whose samples weigh as much as their loss (r - Q(s, a))^2.

    Of chance u and weight w, u^(1/w) is the key of weighted drawing (Efraimidis and Spirakis):
    the sample with the lowest key goes. Keys follow the loss as the network learns. After Buzzega
    et al., "Rethinking Experience Replay: a Bag of Tricks for Continual Learning" (2020).
    """

    def worth(self, there: Situation) -> Floats:
        """The logarithms of the keys, which are in the same order."""
        drawn = np.maximum(chances(there.seed, there.memory.ids), np.finfo(np.float64).tiny)
        return np.log(drawn) / (errors(there) ** 2 + LEAST_LOSS)


def equal_quotas(counts: Ints, total: int) -> list[int]:
    """Return how many of each world stay, `total` together: as equal as their counts allow.

    counts: samples of each world, at least `total` together. What does not divide goes to the
    larger worlds, of equal ones to the later.
    """
    kept, left = [0] * len(counts), total
    for place, world in enumerate(np.argsort(counts, kind="stable")):
        kept[world] = min(int(counts[world]), left // (len(counts) - place))
        left -= kept[world]
    return kept


NORMM, RESERVOIR, HALF, RANDOM = NoRMM(), Reservoir(), Half(), Random()
QUOTAS, QUOTAS_RESERVOIR, WORLDS = Quotas(), QuotasReservoir(), Worlds()
SURPRISE, LOSS_RESERVOIR = Surprise(), LossReservoir()
