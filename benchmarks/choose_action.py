"""P2: how much faster are the values of all actions for one observation, and for eight at once?"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from statistics import median
from typing import Literal

import numpy as np

from benchmarks import frames, plain
from benchmarks.frame import (
    Bar,
    Mode,
    Times,
    interleaved,
    mode_of,
    report,
    rounds_of,
    speedup,
    table,
    times_table,
)
from shared.config import ActorNumerics, Config, Numerics
from shared.numerics import choose
from shared.rl.predictor import Predictor

AT_ONCE = {"P2a": (1, 2.5, 4.5), "P2b": (8, 3.5, 5.5)}
"""Observations at once, required and aimed at."""
SLOWED_AT_MOST = 3.0
PRECISIONS: tuple[Literal["float32", "bfloat16"], ...] = ("float32", "bfloat16")
SPIN = "while True: pass"
AGREEMENT_BATCH = 32


def main(arguments: Sequence[str] | None = None) -> None:
    mode = mode_of(arguments, __doc__)
    chosen = settled(mode)
    bars, tables = [], []
    agreed, third = agreement(mode)
    for name, (at_once, required, aim) in AT_ONCE.items():
        times, found = measure(mode, at_once, chosen)
        tables += found
        bar = speedup(name, times["plain"], times[label(chosen)], required, aim)
        checks = {"actions_equal": agreed[label(chosen)], "threads": float(chosen.threads)}
        bars.append(replace(bar, checks=checks))
    neighbour, beside = beside_a_neighbour(mode, chosen)
    tables += [beside, third]
    report("P2 choosing an action", tables, [*bars, neighbour])


def settled(mode: Mode) -> Numerics:
    """What the actor chooses here when its precision is left open."""
    if mode == "check":
        return ActorNumerics()
    config = Config(network=frames.network_config(mode))
    return choose(config, ActorNumerics(engine="auto", precision="auto"), "actor")


def label(numerics: Numerics) -> str:
    return f"{numerics.engine} {numerics.precision}"


def ways(mode: Mode, batch: int, threads: int = 1) -> list[Numerics]:
    """Every engine in every precision; only plain torch where only the running is checked."""
    engines: tuple[Literal["torch", "openvino"], ...] = ("torch", "openvino")
    return [
        ActorNumerics(engine=engine, precision=precision, batch=batch, threads=threads)
        for engine in (engines[:1] if mode == "check" else engines)
        for precision in PRECISIONS
    ]


def measure(mode: Mode, at_once: int, chosen: Numerics) -> tuple[Times, list[str]]:
    """Times per call with the actor's count of threads, and a table for each count."""
    rounds = rounds_of(mode, short=60, full=400)
    tables, of_chosen = [], Times()
    for threads in (1,) if mode == "check" else sorted({1, 2, chosen.threads}):
        times = interleaved(cases(mode, at_once, threads), rounds, warm_up=5)
        head = f"observations at once: {at_once}, threads: {threads}, times per call"
        tables.append(f"{head}\n\n{times_table(times, 'plain')}")
        if threads == chosen.threads:
            of_chosen = times
    return of_chosen, tables


def cases(mode: Mode, at_once: int, threads: int) -> dict[str, Callable[[], object]]:
    """Values of all actions: trunk once and three heads, plain and ours."""
    config, weights = frames.network_config(mode), frames.trained_weights(mode)
    images = frames.images(mode, at_once)
    naive = plain.network(config, weights)
    found: dict[str, Callable[[], object]] = {
        "plain": partial(plain.all_values, naive, images, threads)
    }
    for numerics in ways(mode, at_once, threads):
        found[label(numerics)] = partial(predictor(mode, numerics).all_values, images)
    return found


def predictor(mode: Mode, numerics: Numerics) -> Predictor:
    """One of ours with the quickly trained weights."""
    ours = Predictor(frames.network_config(mode), numerics)
    ours.load(1, frames.trained_weights(mode))
    return ours


def beside_a_neighbour(mode: Mode, chosen: Numerics) -> tuple[Bar, str]:
    """How much one process that only spins slows a call, for each count of threads."""
    rounds = rounds_of(mode, short=60, full=400)
    images, rows, bar = frames.images(mode, 1), [], None
    for threads in sorted({1, 2, chosen.threads}) if mode != "check" else (1,):
        ours = predictor(mode, chosen.model_copy(update={"batch": 1, "threads": threads}))
        case = {"ours": partial(ours.all_values, images)}
        quiet = median(interleaved(case, rounds, warm_up=5)["ours"]) * 1e3
        with spinning():
            beside = median(interleaved(case, rounds, warm_up=5)["ours"]) * 1e3
        rows.append([threads, quiet, beside, beside / quiet])
        if threads == chosen.threads:
            bar = Bar(
                "P2c", beside / quiet, "x slower", "lower", SLOWED_AT_MOST, SLOWED_AT_MOST,
                quiet, beside, rounds,
            )  # fmt: skip
    assert bar is not None
    head = ["threads", "alone ms", "beside a spinning process ms", "times slower"]
    return bar, table(head, rows)


@contextmanager
def spinning() -> Iterator[None]:
    """One process that uses all it can get of a core."""
    process = subprocess.Popen([sys.executable, "-c", SPIN])
    try:
        time.sleep(0.3)  # until it spins
        yield
    finally:
        process.kill()
        process.wait()


def frames_used(mode: Mode) -> int:
    """Frames the chosen actions are compared on."""
    return {"check": 64, "short": 1000, "full": 10_000}[mode]


def agreement(mode: Mode) -> tuple[dict[str, float], str]:
    """Part of real frames where the greedy action is that of plain float32, by engine, precision.

    The lower of trained and untrained weights; the table tells them apart, and says how often each
    action is the greedy one: where it is always the same, agreement is cheap.
    """
    images, config = frames.images(mode, frames_used(mode)), frames.network_config(mode)
    worst, rows = {label(way): 1.0 for way in ways(mode, AGREEMENT_BATCH)}, []
    for weights, data in (
        ("trained", frames.trained_weights(mode)),
        ("untrained", frames.untrained_weights(mode)),
    ):
        expected = plain.all_values(plain.network(config, data), images, threads=1).argmax(axis=1)
        shares = " ".join(
            f"{part:.0%}" for part in np.bincount(expected, minlength=3) / len(images)
        )
        for way in ways(mode, AGREEMENT_BATCH):
            ours = predictor(mode, way)
            ours.load(1, data)
            equal = float(np.mean(ours.all_values(images).argmax(axis=1) == expected))
            worst[label(way)] = min(worst[label(way)], equal)
            rows.append([label(way), weights, f"{equal:.4%}", shares])
    head = [
        "engine and precision",
        "weights",
        f"actions as plain, {len(images)} frames",
        "share of each",
    ]
    return worst, table(head, rows)


if __name__ == "__main__":
    main()
