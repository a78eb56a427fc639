"""A mutation check: do tests fail when what they guard is broken?

`mutants.toml` lists small errors, each with the tests that must find it. They are made one at a
time in a copy of the tracked files. A mutant whose tests still pass shows a gap in the tests.

    python -m tests.mutate [--only TEXT] [--jobs N]
"""

from __future__ import annotations

import argparse
import importlib.util
import multiprocessing
import os
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from tempfile import TemporaryDirectory

ROOT = Path(__file__).parents[1]
LIST = Path(__file__).with_name("mutants.toml")
DEADLINE_S = 300.0
"""For the tests of one mutant. A test that hangs, or is slow, is none that fails."""
WORDS = {0: "SURVIVED", 1: "caught", None: f"tests do not end within {DEADLINE_S:.0f} s"}
"""By exit code of pytest. Any other one means that the tests could not be run."""
NOT_RUN = 70
"""Exit code where pytest itself fails."""
_PROCESSES = multiprocessing.get_context("forkserver")
_PROCESSES.set_forkserver_preload(["pydantic", "pytest", "torch", "zenoh"])


@dataclass(frozen=True)
class Mutant:
    """One error, and what must find it."""

    file: str
    """From the root of the repository."""
    breaks: str
    """What the error does, in one line."""
    old: str
    """Text that occurs exactly once in the file."""
    new: str
    """What stands there instead."""
    tests: tuple[str, ...]
    """Files or node ids; at least one of these tests must fail."""

    def __str__(self) -> str:
        return f"{self.file}: {self.breaks}"


def read(path: Path = LIST) -> list[Mutant]:
    """All mutants of a list. Raises TypeError for a missing or unknown field."""
    tables = tomllib.loads(path.read_text("utf-8"))["mutant"]
    return [Mutant(**{**table, "tests": tuple(table["tests"])}) for table in tables]


def judged(mutant: Mutant, tree: Path) -> str:
    """What became of a mutant in this tree. The file is afterwards as it was before."""
    path = tree / mutant.file
    sound = path.read_text("utf-8")
    if sound.count(mutant.old) != 1:
        return "does not apply: its old text must occur exactly once"
    try:
        _write(path, sound.replace(mutant.old, mutant.new))
        code = _exit_code(tree, "-x", *mutant.tests)
    finally:
        _write(path, sound)
    return WORDS.get(code, f"tests do not run (exit code {code} of pytest)")


def _write(path: Path, text: str) -> None:
    path.write_text(text, "utf-8")
    # Python compares age in seconds and size: it would take an equally long mutant for the old.
    Path(importlib.util.cache_from_source(str(path))).unlink(missing_ok=True)


def _exit_code(tree: Path, *arguments: str, aloud: bool = False) -> int | None:
    """Run pytest in a process that has the slow imports behind it; None at the deadline."""
    process = _PROCESSES.Process(target=_test, args=(str(tree), arguments, aloud))
    process.start()
    process.join(None if aloud else DEADLINE_S)
    code = process.exitcode
    process.kill()
    process.join()
    return code


def _test(tree: str, arguments: Sequence[str], aloud: bool) -> None:
    """Runs in the new process."""
    import pytest

    os.chdir(tree)
    os.environ["PYTHONPATH"] = tree
    sys.path[:] = [tree, *(path for path in sys.path if path not in ("", str(ROOT)))]
    if not aloud:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
    code = NOT_RUN
    try:
        options = ("-q", "-p", "no:cacheprovider", "--timeout=0")
        code = int(pytest.main([*options, *arguments]))
    finally:
        sys.exit(code)  # an exception would give 1, as a failed test does


def _copy_to(folder: Path) -> None:
    """Copy the tracked files as they are in the working tree."""
    git = shutil.which("git") or "git"
    listed = subprocess.run([git, "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True)
    for name in filter(None, listed.stdout.decode().split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)


def run(mutants: list[Mutant], jobs: int) -> int:
    """Judge all of them, one line each; 0 if all are caught."""
    with TemporaryDirectory(prefix="mutants-") as folder, ThreadPoolExecutor(jobs) as pool:
        trees: SimpleQueue[Path] = SimpleQueue()
        for number in range(jobs):
            tree = Path(folder) / str(number)
            _copy_to(tree)
            trees.put(tree)
        named = sorted({test for mutant in mutants for test in mutant.tests})
        if _exit_code(tree, "-n", str(jobs), *named, aloud=True):
            _say("tests fail without any mutant")
            return 1

        def judge(mutant: Mutant) -> bool:
            tree, start_s = trees.get(), time.monotonic()
            verdict = judged(mutant, tree)
            trees.put(tree)
            _say(f"{verdict:8} {time.monotonic() - start_s:5.1f} s  {mutant}")
            return verdict == "caught"

        start_s = time.monotonic()
        caught = sum(pool.map(judge, mutants))
    _say(f"{caught} of {len(mutants)} caught in {time.monotonic() - start_s:.0f} s")
    return 0 if caught == len(mutants) else 1


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main() -> int:
    """Run what the command line asks for; returns the exit code."""
    os.environ["OMP_NUM_THREADS"] = "1"  # tests run beside each other
    parser = argparse.ArgumentParser(prog="python -m tests.mutate", description=__doc__)
    parser.add_argument("--only", default="", metavar="TEXT", help="in the file or what breaks")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="so many at a time")
    given = parser.parse_args()
    chosen = [mutant for mutant in read() if given.only in str(mutant)]
    if not chosen:
        parser.error(f"--only: no mutant has {given.only!r} in its file or in what it breaks")
    return run(chosen, given.jobs)


if __name__ == "__main__":
    sys.exit(main())
