"""What a strategy keeps of a stream, and what keeping it costs."""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from experiments.retention.refresh import Refresher
from experiments.retention.stream import Stream
from shared.config import Config, Numerics
from shared.facts import SHORT_NAMES
from shared.rl.memory import ReplayMemory
from shared.rl.predictor import Predictor
from shared.rl.retention.most_alike import FAR, hamming
from shared.rl.retention.strategy import strategy
from shared.rl.schedule import due
from shared.rl.turn import maintain

MOST_COMPARED = 4500
"""Samples whose distances are looked at: as many as a memory of the tenth scale holds."""


@dataclass
class Costs:
    """What a strategy did until now."""

    discards: int = 0
    removed: int = 0
    last_resort: int = 0
    seconds: float = 0.0
    """Processor time of all discards."""


@dataclass(frozen=True)
class Mark:
    """A memory at the end of a stage."""

    stage: str
    memory: ReplayMemory
    costs: Costs
    network: Predictor
    """The one in force then."""


def managed(
    stream: Stream,
    config: Config,
    numerics: Numerics,
    ends: Mapping[int, str],
    refresher: Refresher,
    refresh_every: int,
) -> Iterator[Mark]:
    """Let a strategy manage a stream; yield the memory at the ends of stages.

    Args:
        stream: What comes.
        config: Its `memory` is the strategy; its network and seed are those of the stream.
        numerics: How descriptors and values are computed.
        ends: Names of stages by their last episode. The memory goes on to change after each.
        refresher: How rewards are refreshed.
        refresh_every: Actions between two times; 0: never.
    """
    memory = ReplayMemory(config.memory.capacity)
    memory.worlds = list(stream.worlds)
    network, costs = Predictor(config.network, numerics), Costs()
    for turn in stream.turns():
        if turn.version != network.version:
            network.load(turn.version, stream.weights(turn.version))
        if len(turn.rows):
            refresher.note(int(turn.rows["id"][0]) - 1, len(turn.rows), network)
        memory.append(turn.rows, turn.images)
        began_s = time.process_time()
        done = maintain(memory, turn.now, config.memory, network, config.run.seed)
        if len(done.discarded.ids):
            costs.seconds += time.process_time() - began_s
            costs.discards += 1
            costs.removed += len(done.discarded.ids)
            costs.last_resort += done.discarded.told["last_resort"]
        if due(turn.now, 0, refresh_every):
            refresher.refresh(memory, network)
        if stage := ends.get(turn.now.episode):
            yield Mark(stage, memory, costs, network)


def figures(mark: Mark, config: Config) -> dict[str, float]:
    """Return what a memory holds and what it has cost, by name.

    Returns:
        share_<world>, share_<action>: parts of the samples.
        nearest_bits: mean distance of a descriptor from the most similar other one, of 120 bits.
        age: mean age in memories: 1 is a sample that came N samples ago.
        last_resort: part of what was removed that went by age for want of candidates.
        discard_ms: mean processor time of a discard.
        column_bytes: bytes a sample that the strategy adds.
    """
    memory, costs = mark.memory, mark.costs
    rows, count = memory.rows, len(memory)
    worlds = np.bincount(rows["world"], minlength=len(memory.worlds)) / count
    actions = np.array(memory.by_action()) / count
    newest = int(memory.ids[-1])
    ages = (newest - rows["id"].astype(np.int64)) / memory.capacity
    own = np.dtype([("id", "<u8"), *strategy(config.memory.strategy).columns])
    return {
        "samples": count,
        **{f"share_{name}": float(s) for name, s in zip(memory.worlds, worlds, strict=True)},
        **{f"share_{name}": float(s) for name, s in zip(SHORT_NAMES, actions, strict=True)},
        "nearest_bits": _nearest_bits(mark),
        "age": float(ages.mean()),
        "last_resort": costs.last_resort / max(costs.removed, 1),
        "discard_ms": 1000.0 * costs.seconds / max(costs.discards, 1),
        "column_bytes": own.itemsize - 8,
    }


def _nearest_bits(mark: Mark) -> float:
    """Mean Hamming distance to the nearest other sample of the memory, or of 4,500 of them."""
    memory = mark.memory
    some = np.linspace(0, len(memory) - 1, min(len(memory), MOST_COMPARED)).astype(np.int64)
    parts = [mark.network.descriptors(images) for _, images in memory.parts(some)]
    distances = hamming(np.concatenate(parts))(np.arange(len(some)), 0)
    np.fill_diagonal(distances, FAR)
    return float(distances.min(axis=1).mean())
