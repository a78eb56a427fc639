"""`corridor doctor`: whether this machine can run the system, before anything is started.

It changes nothing. What only makes things slower is told and does not count as a failure.
"""

import os
import platform
import resource
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.table import Table

from shared.config import Config
from shared.provenance import version_of

Verdict = Literal["good", "slow", "bad"]
MIB, GIB = 2**20, 2**30
SHARED = "/dev/shm"  # noqa: S108 - looked at, not written to
PROBE_S = 60.0
"""Longest that the import of a library may take."""
PYTHONS = ((3, 11), (3, 14))
"""The first Python that does, and the first that does not yet."""
SHARING = "only with bus.shared_memory"
LIBRARIES = {
    "eclipse-zenoh": "",
    "pydantic": "",
    "torch": "actor, replay, learner",
    "lmdb": "replay",
    "pybullet": "sim",
    "simplejpeg": "driver",
    "rosbags": "ros2",
    "openvino": "openvino",
    "cryptography": "secure",
}
"""Packages that decide what runs here, and the extras that bring them; empty: always needed."""


@dataclass(frozen=True)
class Finding:
    """One thing looked at."""

    what: str
    found: str
    verdict: Verdict = "good"
    advice: str = ""
    """What to do; empty where nothing is wrong."""


def examine(config: Config, folder: Path) -> Iterator[Finding]:
    """Look at everything. folder: where runs are written."""
    fits = PYTHONS[0] <= sys.version_info[:2] < PYTHONS[1]
    advice = "" if fits else "use Python 3.11, 3.12 or 3.13"
    yield Finding("Python", platform.python_version(), "good" if fits else "bad", advice)
    cores = len(os.sched_getaffinity(0))
    yield _atleast("processor cores", cores, 2, "{:d}", "slow", "training and driving take turns")
    free_gib, room_mib = _free_memory_bytes() / GIB, _free_bytes(Path(SHARED)) / MIB
    advice = "end other programs, or choose a smaller memory.capacity"
    yield _atleast("free memory", free_gib, 1.5, "{:.1f} GiB", "bad", advice)
    yield _atleast(SHARED, room_mib, 128, "{:.0f} MiB free", "slow", f"{SHARING}: shm_size")
    yield _limit(
        "lockable memory", resource.RLIMIT_MEMLOCK, 64 * MIB, "slow", f"{SHARING}: ulimit -l"
    )
    yield _limit("address space", resource.RLIMIT_AS, 64 * GIB, "bad", "ulimit -v unlimited")
    yield _limit("open files", resource.RLIMIT_NOFILE, 1024, "bad", "ulimit -n 4096")
    yield _disk(folder)
    yield _endpoint(config.bus.endpoint)
    yield _clock()
    yield from _libraries()
    yield _gpu()


def run(config: Config, folder: Path) -> int:
    """Print what was found and, last, what to do; returns the exit code."""
    table = Table(box=None, pad_edge=False)
    for column in ("", "what", "found", "what to do"):
        table.add_column(column)
    findings = list(examine(config, folder))
    for finding in findings:
        table.add_row(finding.verdict, finding.what, finding.found, finding.advice)
    console = Console(markup=False, emoji=False, highlight=False)
    console.print(table)
    bad = [finding for finding in findings if finding.verdict == "bad"]
    console.print("ready" if not bad else "not ready: " + "; ".join(f.advice for f in bad))
    return 1 if bad else 0


def _atleast(
    what: str, value: float, least: float, form: str, otherwise: Verdict, advice: str
) -> Finding:
    found = form.format(value)
    if value >= least:
        return Finding(what, found)
    return Finding(what, f"{found}, expected {form.format(least)}", otherwise, advice)


def _limit(what: str, number: int, least: int, otherwise: Verdict, advice: str) -> Finding:
    soft, _ = resource.getrlimit(number)
    if soft == resource.RLIM_INFINITY:
        return Finding(what, "unlimited")
    big = least >= MIB
    unit = MIB if big else 1
    return _atleast(what, soft / unit, least / unit, "{:.0f}" + " MiB" * big, otherwise, advice)


def _free_memory_bytes() -> int:
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    return 0


def _free_bytes(folder: Path) -> int:
    return shutil.disk_usage(folder).free if folder.is_dir() else 0


def _disk(folder: Path) -> Finding:
    there = next(place for place in (folder, *folder.absolute().parents) if place.is_dir())
    if not os.access(there, os.W_OK):
        return Finding(f"disk, {there}", "not writable", "bad", "choose a folder with --run-dir")
    return _atleast(
        f"disk, {there}", _free_bytes(there) / GIB, 2, "{:.1f} GiB free", "bad", "make room"
    )


def _endpoint(endpoint: str) -> Finding:
    """Whether somebody listens there, or could."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    what = f"router, {endpoint}"
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=1.0):
            return Finding(what, "somebody listens there")
    except ConnectionRefusedError:
        return Finding(what, "nobody listens: free for a router")
    except (OSError, ValueError) as error:
        return Finding(what, str(error), "bad", "see bus.endpoint")


def _clock() -> Finding:
    """A clock before the program itself was written was never set."""
    written_s = Path(__file__).stat().st_mtime
    found = time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime()) + " UTC"
    if time.time() + 86400 > written_s:
        return Finding("clock", found)
    return Finding("clock", found, "bad", "set it: it is older than this program")


def _libraries() -> Iterator[Finding]:
    for package, extras in LIBRARIES.items():
        version = version_of(package)
        if not version:
            verdict: Verdict = "good" if extras else "bad"
            advice = "" if extras else f"pip install {package}"
            yield Finding(package, f"not installed (extra {extras})", verdict, advice)
        elif fault := _import_fault("zenoh" if package == "eclipse-zenoh" else package):
            # What only makes it quicker is left out by itself.
            verdict = "slow" if package == "openvino" else "bad"
            yield Finding(package, f"{version}, {fault}", verdict, f"reinstall {package}")
        else:
            yield Finding(package, version)


def _gpu() -> Finding:
    if not version_of("torch"):
        return Finding("GPU", "unknown without torch")
    code = "import torch; print(torch.cuda.get_device_name() if torch.cuda.is_available() else '')"
    name = _python_says(code)[1].strip()
    return Finding("GPU", name or "none that torch can use", "good" if name else "slow")


def _import_fault(module: str) -> str:
    """How the import ends in a process of its own: some libraries kill it; empty: well."""
    code, text = _python_says(f"import {module}")
    if code == 0:
        return ""
    return f"cannot be imported: {text.strip().splitlines()[-1] if text.strip() else code}"


def _python_says(code: str) -> tuple[int, str]:
    try:
        command = [sys.executable, "-P", "-c", code]
        done = subprocess.run(command, capture_output=True, text=True, timeout=PROBE_S, check=False)
    except subprocess.TimeoutExpired:
        return 1, f"took longer than {PROBE_S:.0f} s"
    return done.returncode, done.stdout + done.stderr
