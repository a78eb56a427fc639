"""P4: what does the search for discard candidates cost, and discarding for one episode?"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from statistics import median
from types import SimpleNamespace

import numpy as np
import numpy.typing as npt

from benchmarks import frames
from benchmarks.frame import Bar, Mode, interleaved, mode_of, report, rounds_of, table
from shared.config import MemoryConfig, Numerics
from shared.facts import IMAGE_SHAPE
from shared.provenance import ROOT
from shared.rl.memory import SAMPLE, ReplayMemory
from shared.rl.predictor import Predictor
from shared.rl.retention.strategy import Situation, discard
from shared.rl.similarity import similar_to_newer

Descriptors = npt.NDArray[np.uint8]
COUNT: dict[Mode, int] = {"check": 300, "short": 30_000, "full": 30_000}
THRESHOLDS: dict[Mode, tuple[int, ...]] = {
    "check": (1, 8), "short": (1, 2, 4, 8), "full": tuple(range(1, 9))
}  # fmt: skip
STORED: dict[Mode, int] = {"check": 3000, "short": 90_000, "full": 90_000}
EPISODE = 500
EVERY: dict[Mode, int] = {"check": 1, "short": 20, "full": 1}
"""The loop over rows takes every row, or every 20th: its time is then extrapolated, and said so."""
PEAK = """
import json, sys
import numpy as np
from benchmarks.candidate_search import forget_high_water, memory_mb, similar_to_newer
descriptors = np.load(sys.argv[1])
similar_to_newer(descriptors[:64], 8, sys.argv[3])
forget_high_water()
before = memory_mb("VmRSS")
similar_to_newer(descriptors, int(sys.argv[2]), sys.argv[3])
print(json.dumps(memory_mb("VmHWM") - before))
"""


def main(arguments: Sequence[str] | None = None) -> None:
    mode = mode_of(arguments, __doc__)
    sets = descriptor_sets(mode)
    times, first = search_times(mode, sets)
    name, bits = max(times, key=lambda case: times[case])
    slowest, rounds = times[name, bits], rounds_of(mode, short=1, full=3)
    loop_s, text = against_the_loop(mode, sets[name], bits, slowest)
    peak, second = peaks(mode, sets)
    turn, third = episode_turn(mode)
    bars = [
        Bar("P4a", slowest, "s", "lower", 5.0, 1.5, loop_s * 1e3, slowest * 1e3, rounds),
        Bar("P4b", loop_s / slowest, "x", "higher", 10.0, 10.0, loop_s * 1e3, slowest * 1e3, 1),
        Bar("P4c", peak, "MB", "lower", 150.0, 150.0, None, None, 2 * len(sets)),
        turn,
    ]
    report("P4 search for candidates", [first, text, second, third], bars)


def descriptor_sets(mode: Mode) -> dict[str, Descriptors]:
    """Descriptors of one action: real ones, equal ones (all pairs match), random ones (none)."""
    count = COUNT[mode]
    sets = {
        "trained network": described(mode, frames.trained_weights(mode)),
        "untrained network": described(mode, frames.untrained_weights(mode)),
    }
    draw = np.random.default_rng(frames.SEED)
    spread = {name: to_count(found, count, draw) for name, found in sets.items()}
    return spread | {
        "all equal": np.full((count, 15), 7, np.uint8),
        "random": draw.integers(0, 256, (count, 15), np.uint8),
    }


def described(mode: Mode, weights: bytes) -> Descriptors:
    """Descriptors of the frames, as many as are needed and there."""
    predictor = Predictor(frames.network_config(mode), Numerics(precision="bfloat16"))
    predictor.load(1, weights)
    used = {"check": 150, "short": 1500, "full": COUNT["full"]}[mode]
    return predictor.descriptors(frames.images(mode, used))


def to_count(found: Descriptors, count: int, draw: np.random.Generator) -> Descriptors:
    """As many descriptors as wanted: further ones are found ones with one bit in 20 flipped."""
    if len(found) >= count:
        return found[:count]
    more = found[draw.integers(0, len(found), count - len(found))]
    flips = np.packbits(draw.random((len(more), 120)) < 0.05, axis=1)
    return np.concatenate([found, more ^ flips])


def search_times(
    mode: Mode, sets: dict[str, Descriptors]
) -> tuple[dict[tuple[str, int], float], str]:
    """Median seconds of a search by set and threshold, and a table with the part that matches."""
    times: dict[tuple[str, int], float] = {}
    rows: list[list[object]] = []
    for name, descriptors in sets.items():
        for bits in THRESHOLDS[mode]:
            marks = {rule: similar_to_newer(descriptors, bits, rule) for rule in ("paper", "cover")}
            spent = interleaved(
                {
                    "paper": partial(similar_to_newer, descriptors, bits, "paper"),
                    "cover": partial(similar_to_newer, descriptors, bits, "cover"),
                },
                rounds_of(mode, short=1, full=3),
                warm_up=0,
            )
            paper, cover = median(spent["paper"]), median(spent["cover"])
            times[name, bits] = paper
            rows.append([name, bits, f"{marks['paper'].mean():.2%}", paper, cover])
    head = ["descriptors", "threshold bits", "candidates", "paper rule s", "cover rule s"]
    return times, f"{COUNT[mode]} samples of one action\n\n{table(head, rows)}"


def against_the_loop(
    mode: Mode, descriptors: Descriptors, bits: int, ours_s: float
) -> tuple[float, str]:
    """Seconds of a loop over rows in plain numpy, and that it finds the same candidates."""
    every = EVERY[mode]
    rows = range(0, len(descriptors), every)
    start_s = time.perf_counter()
    found = [loop_row(descriptors, row, bits) for row in rows]
    loop_s = (time.perf_counter() - start_s) * len(descriptors) / len(rows)
    expected = similar_to_newer(descriptors, bits, "paper")[::every]
    assert found == list(expected), "the loop over rows finds other candidates"
    how = "measured" if every == 1 else f"extrapolated from every {every}th row"
    head = ["case", "s", "times loop"]
    cells = [[f"loop over rows, {how}", loop_s, 1.0], ["ours", ours_s, loop_s / ours_s]]
    return loop_s, f"slowest set, {bits} bits\n\n{table(head, cells)}"


def loop_row(descriptors: Descriptors, row: int, bits: int) -> bool:
    """Whether some newer row is similar to this one."""
    distances = np.bitwise_count(descriptors[row + 1 :] ^ descriptors[row]).sum(axis=1)
    return bool((distances <= bits).any())


def peaks(mode: Mode, sets: dict[str, Descriptors]) -> tuple[float, str]:
    """Most memory a search takes beyond the descriptors, in MB, each in a process of its own."""
    rows: list[list[object]] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "descriptors.npy"
        for name, descriptors in sets.items():
            np.save(path, descriptors)
            for rule in ("paper",) if mode == "check" else ("paper", "cover"):
                command = [sys.executable, "-c", PEAK, str(path), "1", rule]
                out = subprocess.run(command, cwd=ROOT, check=True, capture_output=True).stdout
                rows.append([name, rule, json.loads(out.splitlines()[-1])])
            if mode == "check":
                break
    most = max(float(str(row[2])) for row in rows)
    return most, table(["descriptors", "rule", "memory beyond them MB"], rows)


def memory_mb(name: str) -> float:
    """A figure of this process's memory: VmRSS is now, VmHWM the most so far (Linux)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) / 1024
    raise OSError(f"no {name} in /proc/self/status")


def forget_high_water() -> None:
    """Let VmHWM begin anew at what is used now."""
    Path("/proc/self/clear_refs").write_text("5")


def episode_turn(mode: Mode) -> tuple[Bar, str]:
    """Append an episode to a full memory and discard as many, candidates being known."""
    memory, config = ReplayMemory(STORED[mode]), MemoryConfig(capacity=STORED[mode])
    memory.world_indices(["plus"])
    images = frames.images(mode, EPISODE)
    network = SimpleNamespace(version=1, descriptors=no_description)
    appends, discards, both = [], [], []
    for _ in range(rounds_of(mode, short=10, full=50)):
        fill_up(memory)
        rows = next_rows(memory, EPISODE)
        start_s = time.perf_counter()
        memory.append(rows, images)
        between_s = time.perf_counter()
        done = discard(Situation(memory, 0, config, network, seed=1))
        end_s = time.perf_counter()
        assert len(done.ids)
        assert not done.told["recomputed"]
        appends.append((between_s - start_s) * 1e3)
        discards.append((end_s - between_s) * 1e3)
        both.append((end_s - start_s) * 1e3)
    rows_of = (("append", appends), ("discard", discards), ("both", both))
    cells = [[name, median(spent), max(spent)] for name, spent in rows_of]
    head = [f"{EPISODE} samples at {STORED[mode]}", "median ms", "worst ms"]
    bar = Bar("P4d", median(both), "ms", "lower", 20.0, 5.0, None, median(both), len(both))
    return bar, table(head, cells)


def fill_up(memory: ReplayMemory) -> None:
    """Append black images up to the capacity, half of them marked."""
    while missing := min(4096, memory.capacity - len(memory)):
        memory.append(next_rows(memory, missing), np.zeros((missing, *IMAGE_SHAPE), np.uint8))


def next_rows(memory: ReplayMemory, count: int) -> npt.NDArray[np.void]:
    """Rows to append: actions in turn, every other one a candidate."""
    rows = np.zeros(count, SAMPLE)
    last = int(memory.ids[-1]) if len(memory) else 0
    rows["id"] = last + 1 + np.arange(count)
    rows["action"] = rows["id"] % 3
    rows["described_by"] = rows["marked_by"] = 1
    rows["candidate"] = rows["id"] // 3 % 2 == 0
    return rows


def no_description(_: Descriptors, __: object) -> Descriptors:
    """Stands for the predictor where no descriptors should be needed."""
    raise AssertionError("candidates ran out")


if __name__ == "__main__":
    main()
