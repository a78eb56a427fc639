"""P3: how much faster are descriptors and values of a whole memory, and is nothing done twice?"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import cycle, product
from statistics import median
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks import frames, plain
from benchmarks.frame import Bar, Mode, interleaved, mode_of, report, speedup, table, times_table
from shared.config import Config, MemoryConfig, Numerics
from shared.numerics import choose
from shared.rl.memory import SAMPLE, ReplayMemory
from shared.rl.predictor import Predictor
from shared.rl.retention.rmm import recompute_marks
from shared.rl.retention.strategy import Situation

REQUIRED, AIM = 4.0, 7.0
PARTS = 5
"""A pass is measured in so many parts, plain and ours in turns."""
COUNT: dict[Mode, int] = {"check": 100, "short": 1500, "full": 45_000}
Array = npt.NDArray[Any]
Pass = Callable[[Array], Array]


def main(arguments: Sequence[str] | None = None) -> None:
    mode = mode_of(arguments, __doc__)
    numerics = settled(mode)
    ours = predictor(mode, numerics)
    net = plain.network(frames.network_config(mode), frames.trained_weights(mode))
    threads, load_s = numerics.threads, loading_s(mode, ours)
    descriptors, first = measured(
        "P3a",
        f"descriptors, {numerics.engine} {numerics.precision}, {threads} threads",
        mode,
        lambda images: plain.descriptors(net, images, threads),
        ours.descriptors,
        load_s,
    )
    values, second = measured(
        "P3b",
        f"values of all actions, {numerics.engine} {numerics.precision}, {threads} threads",
        mode,
        lambda images: plain.all_values(net, images, threads),
        ours.all_values,
        load_s,
    )
    agreed, third = agreement(mode, numerics)
    descriptors = replace(descriptors, checks=agreed)
    values = replace(values, checks={"threads": float(threads)})
    twice, fourth = second_pass(mode, ours)
    tables = [first, second, third, fourth]
    report("P3 passes over the whole memory", tables, [descriptors, values, twice])


def settled(mode: Mode) -> Numerics:
    """What replay chooses here when threads and precision are left open."""
    if mode == "check":
        return Numerics()
    config = Config(network=frames.network_config(mode))
    wanted = Numerics(threads=0, engine="auto", precision="auto")
    return choose(config, wanted, "replay")


def predictor(mode: Mode, numerics: Numerics) -> Predictor:
    """Ours with the quickly trained weights."""
    ours = Predictor(frames.network_config(mode), numerics)
    ours.load(1, frames.trained_weights(mode))
    return ours


def loading_s(mode: Mode, ours: Predictor) -> float:
    """Seconds to get ready for a new version of the weights, once in every pass."""
    load = partial(ours.load, 1, frames.trained_weights(mode))
    return median(interleaved({"load": load}, rounds=7)["load"])


def measured(
    name: str, what: str, mode: Mode, baseline: Pass, ours: Pass, load_s: float
) -> tuple[Bar, str]:
    """One pass over all images in parts, plain and ours in turns.

    Each part bears its share of loading the weights, as if the pass had 45,000 images.
    """
    count = COUNT[mode]
    parts = np.array_split(frames.images(mode, count), PARTS)
    times = interleaved({"plain": in_parts(baseline, parts), "ours": in_parts(ours, parts)}, PARTS)
    share_s = load_s * count / PARTS / COUNT["full"]
    times["ours"] = [spent + share_s for spent in times["ours"]]
    rows = [
        [case, sum(spent), count / sum(spent), sum(times["plain"]) / sum(spent)]
        for case, spent in times.items()
    ]
    whole = table(["case", "whole pass s", "images per s", "times plain"], rows)
    head = f"{what}, {count} images in {PARTS} parts; new weights take {load_s * 1e3:.0f} ms"
    text = f"{head}\n\n{times_table(times, 'plain')}\n\n{whole}"
    return speedup(name, times["plain"], times["ours"], REQUIRED, AIM), text


def in_parts(work: Pass, parts: Sequence[Array]) -> Callable[[], object]:
    """A case that takes the next part at each call."""
    turns = cycle(parts)
    return lambda: work(next(turns))


def agreement(mode: Mode, numerics: Numerics) -> tuple[dict[str, float], str]:
    """Equal bits of descriptors with float32, on real frames, trained and untrained weights."""
    images = frames.images(mode, min(COUNT[mode], 10_000))
    found, rows = {}, []
    engines = ("torch",) if mode == "check" else ("torch", "openvino")
    for engine, precision in product(engines, ("float32", "bfloat16")):
        own = numerics.model_copy(update={"engine": engine, "precision": precision})
        for weights, data in (
            ("trained", frames.trained_weights(mode)),
            ("untrained", frames.untrained_weights(mode)),
        ):
            net = plain.network(frames.network_config(mode), data)
            expected = plain.descriptors(net, images, numerics.threads)
            ours = Predictor(frames.network_config(mode), own)
            ours.load(1, data)
            unequal = np.bitwise_count(ours.descriptors(images) ^ expected).sum(axis=1)
            bits, whole = 1.0 - unequal.mean() / 120.0, float(np.mean(unequal == 0))
            rows.append([f"{engine} {precision}", weights, f"{bits:.4%}", f"{whole:.2%}"])
            if own == numerics:
                found[f"descriptor_bits_equal_{weights}"] = float(bits)
    head = [
        "engine and precision",
        "weights",
        f"bits as plain, {len(images)} images",
        "whole descriptors",
    ]
    return found, table(head, rows)


def second_pass(mode: Mode, ours: Predictor) -> tuple[Bar, str]:
    """Mark all, append an episode, mark all again under the same weights: who is described?"""
    added = max(COUNT[mode] // 30, 10)
    images = frames.images(mode, COUNT[mode])
    memory, described, spent = ReplayMemory(len(images)), [0, 0], [0.0, 0.0]
    memory.world_indices(["plus"])
    for turn, part in enumerate((images[:-added], images[-added:])):
        append(memory, part)

        def describe(some: Array, _: object, turn: int = turn) -> Array:
            described[turn] += len(some)
            return ours.descriptors(some)

        start_s = time.perf_counter()
        network = SimpleNamespace(version=ours.version, descriptors=describe)
        recompute_marks(Situation(memory, 0, MemoryConfig(), network, seed=1), 1)
        spent[turn] = time.perf_counter() - start_s
    rows = [
        [name, len(images) - added * (1 - turn), described[turn], spent[turn]]
        for turn, name in enumerate(("first", f"second, after {added} new samples"))
    ]
    text = table(["pass under the same weights", "samples", "images described", "s"], rows)
    bar = Bar(
        "P3c", described[1] / added, "images described per new sample", "lower", 1.0, 1.0,
        spent[0] * 1e3, spent[1] * 1e3, 1,
    )  # fmt: skip
    return bar, text


def append(memory: ReplayMemory, images: Array) -> None:
    """Add samples with these images and actions in turn."""
    rows = np.zeros(len(images), SAMPLE)
    rows["id"] = len(memory) + 1 + np.arange(len(images))
    rows["action"] = rows["id"] % 3
    memory.append(rows, images)


if __name__ == "__main__":
    main()
