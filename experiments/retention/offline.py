"""Choosing from everything that came: no strategy can, but it shows what a good choice is worth."""

from collections.abc import Iterator, Mapping
from typing import Literal

import numpy as np
import numpy.typing as npt

from experiments.retention.contents import Costs, Mark
from experiments.retention.stream import Stream
from shared.config import Config, Numerics
from shared.rl.memory import PART, SAMPLE, ReplayMemory
from shared.rl.predictor import Predictor
from shared.rl.retention.strategy import kept_in_total

Method = Literal["k-centre", "herding"]
"""k-centre: again and again the sample farthest from all chosen ones.
herding: so that the mean descriptor of the chosen ones is that of all."""
Ranks = npt.NDArray[np.int64]
Signs = npt.NDArray[np.float32]


def selected(
    stream: Stream, config: Config, numerics: Numerics, ends: Mapping[int, str], method: Method
) -> Iterator[Mark]:
    """Choose floor(0.99 N) samples from all that came until the end of each stage.

    Args: as for `contents.managed`; descriptors are those of the network in force then.
    """
    network, count = Predictor(config.network, numerics), 0
    for turn in stream.turns():
        count += len(turn.rows)
        if turn.now.episode not in ends:
            continue
        network.load(turn.version, stream.weights(turn.version))
        parts = [
            network.descriptors(np.array(stream.images[start : min(start + PART, count)]))
            for start in range(0, count, PART)
        ]
        signs = np.unpackbits(np.concatenate(parts), axis=1).astype(np.float32) * 2.0 - 1.0
        ranks = choose(method, signs, kept_in_total(config.memory.capacity))
        yield Mark(ends[turn.now.episode], _memory(stream, config, ranks), Costs(), network)


def choose(method: Method, signs: Signs, count: int) -> Ranks:
    """Choose so many of n descriptors, -1 or 1 each, float32 [n, bits]; ranks ascending."""
    chooser = _k_centre if method == "k-centre" else _herding
    return np.sort(chooser(signs, min(count, len(signs))))


def _k_centre(signs: Signs, count: int) -> Ranks:
    chosen = [len(signs) - 1]
    nearest = signs @ signs[-1]  # the largest product with a chosen one: the smallest distance
    nearest[-1] = np.inf
    while len(chosen) < count:
        farthest = int(np.argmin(nearest))
        chosen.append(farthest)
        np.maximum(nearest, signs @ signs[farthest], out=nearest)
        nearest[chosen[-1]] = np.inf
    return np.array(chosen)


def _herding(signs: Signs, count: int) -> Ranks:
    mean, total = signs.mean(axis=0), np.zeros(signs.shape[1], np.float32)
    free, chosen = np.ones(len(signs), np.bool_), []
    for done in range(count):
        gains = signs @ (mean * (done + 1) - total)
        best = int(np.argmax(np.where(free, gains, -np.inf)))
        free[best] = False
        total += signs[best]
        chosen.append(best)
    return np.array(chosen)


def _memory(stream: Stream, config: Config, ranks: Ranks) -> ReplayMemory:
    memory = ReplayMemory(config.memory.capacity)
    memory.worlds = list(stream.worlds)
    rows = np.zeros(len(ranks), SAMPLE)
    for name in stream.samples.dtype.names or ():
        rows[name] = stream.samples[name][ranks]
    memory.append(rows, np.array(stream.images[ranks]))
    return memory
